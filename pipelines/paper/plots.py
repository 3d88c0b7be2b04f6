"""Figures as SVG text: histograms, alone and side by side, bars, points of a graph, lines."""

import io
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import ColmapVgError

try:
    import matplotlib as mpl
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise ColmapVgError('figures need matplotlib: pip install "colmap-vg[plots]"') from error

Array = NDArray[np.float64]

SIZE_INCHES = (5.0, 2.7)
PANEL_INCHES, FRAME_INCHES, PANELS_PER_ROW = (1.8, 1.4), 0.7, 4
"""Of small multiples; the frame is the height of title and label."""
EMPTY_BIN = 0.5
"""Where a logarithmic axis of counts begins."""
STYLE = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "colmap_vg",  # the same figure has the same bytes
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    # Okabe and Ito's colours, which colour-blind readers tell apart; once they are used up, with other lines and marks.
    "axes.prop_cycle": mpl.cycler(linestyle=["-", "--"], marker=["o", "s"])
    * mpl.cycler(color=["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#000000"]),
}


def histogram_svg(title: str, label: str, bins: Array, counts: Mapping[str, Array]) -> str:
    """Histograms over the same bins, as outlines; counts on a logarithmic axis.

    Parameters
    ----------
    title, label : str
        `label` is the horizontal axis's.
    bins : (k + 1,) array
        Edges of the bins.
    counts : mapping of name to (k,) array
    """
    with mpl.rc_context(STYLE):
        figure, axes = _empty(title)
        for name, values in counts.items():
            _outline(axes, bins, values, name)
        axes.set(xlabel=label, ylabel="edges", yscale="log", ylim=(EMPTY_BIN, None))
        axes.legend(frameon=False)
        return _text_of(figure)


def histograms_svg(title: str, label: str, bins: Array, panels: Mapping[str, Mapping[str, Array]]) -> str:
    """Small histograms side by side, each as :func:`histogram_svg` draws it, with the same axes.

    Parameters
    ----------
    title, label : str
        `label` is the horizontal axes'.
    bins : (k + 1,) array
        Edges of the bins.
    panels : mapping of name to mapping of name to (k,) array
        At least one panel: the name over it, and its counts. The legend has the names of all counts.
    """
    num_rows = -(-len(panels) // PANELS_PER_ROW)
    num_columns = min(len(panels), PANELS_PER_ROW)
    with mpl.rc_context(STYLE):
        size = (max(PANEL_INCHES[0] * num_columns, SIZE_INCHES[0]), PANEL_INCHES[1] * num_rows + FRAME_INCHES)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(num_rows, num_columns, sharex=True, sharey=True, squeeze=False).ravel()
        handles: dict[str, Artist] = {}
        for axes, (panel, counts) in zip(grid, panels.items(), strict=False):
            axes.set_title(panel)
            for name, values in counts.items():
                handles[name] = _outline(axes, bins, values, name)
            axes.set(yscale="log", ylim=(EMPTY_BIN, None))
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        for axes in grid[max(len(panels) - num_columns, 0) : len(panels)]:  # the lowest of each column
            axes.tick_params(labelbottom=True)
        figure.suptitle(title)
        figure.supxlabel(label)
        figure.supylabel("edges")
        figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside upper right")
        return _text_of(figure)


def bars_svg(title: str, label: str, shares: Mapping[str, float]) -> str:
    """A bar for each name, from 0 to 1, with its percentage."""
    with mpl.rc_context(STYLE):
        figure, axes = _empty(title)
        bars = axes.bar(list(shares), list(shares.values()), width=0.7)
        axes.bar_label(bars, [f"{100 * share:.3g} %" for share in shares.values()])
        axes.set(ylabel=label, ylim=(0.0, 1.1))
        return _text_of(figure)


def ratios_svg(title: str, label: str, ratios: Mapping[str, Mapping[str, float]]) -> str:
    """Bars of several kinds of ratios for each name, with a line at one."""
    names = list(dict.fromkeys(name for kind in ratios.values() for name in kind))
    width = 0.8 / max(len(ratios), 1)
    with mpl.rc_context(STYLE):
        figure, axes = _empty(title)
        for number, (kind, values) in enumerate(ratios.items()):
            places = np.arange(len(names)) + (number - (len(ratios) - 1) / 2) * width
            axes.bar(places, [values.get(name, 0.0) for name in names], width=width, label=kind)
        axes.axhline(1.0, color="0.4", linewidth=0.8)
        axes.set_xticks(np.arange(len(names)), names, rotation=20, ha="right")
        axes.set(ylabel=label)
        axes.legend(frameon=False)
        return _text_of(figure)


def points_svg(title: str, edges: NDArray[np.int64], truth: Array, points: Mapping[str, Array]) -> str:
    """A plane graph and other placements of its vertices: `truth` and each of `points` are (n, 2)."""
    with mpl.rc_context(STYLE):
        figure, axes = _empty(title)
        axes.plot(
            *np.moveaxis(truth[edges], 2, 0).swapaxes(1, 2), color="#bbbbbb", linewidth=0.8, linestyle="-", marker=""
        )
        for name, centers in {"truth": truth, **points}.items():
            axes.plot(*centers.T, linestyle="none", fillstyle="none", label=name)
        axes.set(aspect="equal", xticks=[], yticks=[])
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return _text_of(figure)


def lines_svg(
    title: str,
    label: str,
    height: str,
    series: Mapping[str, tuple[Array, Array]],
    marks: Mapping[str, float] | None = None,
) -> str:
    """Lines, both axes logarithmic.

    Parameters
    ----------
    title, label, height : str
        `label` is the horizontal axis's, `height` the vertical one's.
    series : mapping of name to ((k,) abscissas, (k,) ordinates)
    marks : mapping of name to abscissa, optional
        Dotted vertical lines with their names.
    """
    with mpl.rc_context(STYLE):
        figure, axes = _empty(title)
        for name, (x, y) in series.items():
            axes.loglog(x, y, markersize=3, label=name)
        for number, (name, x) in enumerate((marks or {}).items()):
            axes.axvline(x, color="0.4", linewidth=0.8, linestyle=":")
            place = {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points"}
            axes.annotate(name, (x, 0.0), xytext=(3, 3 + 10 * number), color="0.4", **place)
        ticks = np.unique(np.concatenate([x for x, _ in series.values()]))
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.set(xlabel=label, ylabel=height)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return _text_of(figure)


def _empty(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    axes.set_prop_cycle(STYLE["axes.prop_cycle"])
    return figure, axes


def _outline(axes: Axes, bins: Array, counts: Array, name: str) -> Artist:
    """Draw one histogram with a logarithmic axis of counts."""
    return axes.stairs(np.maximum(counts, EMPTY_BIN), bins, baseline=EMPTY_BIN, fill=True, alpha=0.3, label=name)


def _text_of(figure: Figure) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
