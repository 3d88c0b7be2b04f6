"""Figures as SVG text, drawn by hand: histograms, bars and points need no plotting package.

Colours are Okabe and Ito's, which colour-blind readers tell apart.
"""

from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#000000")
WIDTH, HEIGHT = 480, 260
LEFT, RIGHT, TOP, BOTTOM = 60, 15, 45, 45


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
    most = max((float(np.max(c)) for c in counts.values()), default=1.0)
    decades = max(1, int(np.ceil(np.log10(max(most, 2.0)))))
    x, y = _Axis(float(bins[0]), float(bins[-1]), LEFT, WIDTH - RIGHT), _Axis(-0.3, decades, HEIGHT - BOTTOM, TOP)
    body = []
    for color, values in zip(COLORS, counts.values(), strict=False):
        heights = np.where(values > 0, np.log10(np.maximum(values, 1.0)), -0.3)
        points = [(bins[0], -0.3)]
        for k, height in enumerate(heights):
            points += [(bins[k], height), (bins[k + 1], height)]
        points.append((bins[-1], -0.3))
        path = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in points)
        body.append(f'<polyline points="{path}" fill="{color}" fill-opacity="0.2" stroke="{color}" stroke-width="1"/>')
    ticks = [(float(v), f"{v:g}") for v in np.linspace(bins[0], bins[-1], 7).round(6)]
    body += _axes(x, y, ticks, [(d, f"{10**d:g}") for d in range(decades + 1)], label, "edges")
    return _document(title, [*body, *_legend(list(counts))])


def bars_svg(title: str, label: str, shares: Mapping[str, float]) -> str:
    """Horizontal positions for names, heights from 0 to 1."""
    x, y = _Axis(0.0, len(shares), LEFT, WIDTH - RIGHT), _Axis(0.0, 1.0, HEIGHT - BOTTOM, TOP)
    body = []
    for k, share in enumerate(shares.values()):
        width, height = x(0.7) - x(0.0), y(0.0) - y(share)
        body.append(
            f'<rect x="{x(k + 0.15):.1f}" y="{y(share):.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'fill="{COLORS[0]}"/>'
        )
        body.append(_text(x(k + 0.5), y(share) - 4, f"{100 * share:.3g} %", "middle"))
    ticks = [(k + 0.5, name) for k, name in enumerate(shares)]
    body += _axes(x, y, ticks, [(v, f"{v:g}") for v in (0.0, 0.25, 0.5, 0.75, 1.0)], "", label)
    return _document(title, body)


def points_svg(title: str, edges: NDArray[np.int64], truth: Array, points: Mapping[str, Array]) -> str:
    """A plane graph in blue and other placements of its vertices: `truth` and each of `points` are (n, 2)."""
    every = np.concatenate([truth, *points.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    size = float(max((high - low).max(), 1e-9))
    middle, pixels = 0.5 * (low + high), HEIGHT - TOP - 20
    x = _Axis(middle[0] - size / 2, middle[0] + size / 2, LEFT, LEFT + pixels)
    y = _Axis(middle[1] - size / 2, middle[1] + size / 2, HEIGHT - 20, TOP)
    body = [
        f'<line x1="{x(truth[i, 0]):.1f}" y1="{y(truth[i, 1]):.1f}" x2="{x(truth[j, 0]):.1f}" '
        f'y2="{y(truth[j, 1]):.1f}" stroke="#bbbbbb"/>'
        for i, j in edges
    ]
    for color, centers in zip(COLORS, [truth, *points.values()], strict=False):
        body += [
            f'<circle cx="{x(a):.1f}" cy="{y(b):.1f}" r="4" fill="none" stroke="{color}" stroke-width="1.5"/>'
            for a, b in centers
        ]
    return _document(title, [*body, *_legend(["truth", *points], LEFT + pixels + 40)])


def growth_svg(title: str, label: str, series: Mapping[str, tuple[Array, Array]]) -> str:
    """Lines of seconds over sizes, both axes logarithmic.

    Parameters
    ----------
    title, label : str
        `label` is the horizontal axis's.
    series : mapping of name to ((k,) sizes, (k,) seconds)
    """
    sizes = np.log10(np.concatenate([a for a, _ in series.values()]))
    seconds = np.log10(np.concatenate([b for _, b in series.values()]))
    low, high = float(sizes.min()) - 0.05, float(sizes.max()) + 0.05
    bottom, top = float(np.floor(seconds.min())), float(np.ceil(seconds.max() + 1e-9))
    x, y = _Axis(low, high, LEFT, WIDTH - RIGHT - 110), _Axis(bottom, max(top, bottom + 1), HEIGHT - BOTTOM, TOP)
    body = []
    for color, (own_sizes, own_seconds) in zip(COLORS, series.values(), strict=False):
        points = [(x(np.log10(a)), y(np.log10(b))) for a, b in zip(own_sizes, own_seconds, strict=True)]
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        body.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        body += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/>' for a, b in points]
    every = np.unique(np.concatenate([a for a, _ in series.values()]))
    x_ticks = [(float(np.log10(v)), f"{v:g}") for v in every[:: max(1, len(every) // 5)]]
    y_ticks = [(d, f"{10.0**d:g}") for d in np.arange(bottom, max(top, bottom + 1) + 1)]
    body += _axes(x, y, x_ticks, y_ticks, label, "seconds")
    return _document(title, [*body, *_legend(list(series))])


class _Axis:
    """Linear map from a range of values to pixels."""

    def __init__(self, low: float, high: float, first: float, last: float) -> None:
        self._low, self.first, self.last = low, first, last
        self._scale = (last - first) / (high - low)

    def __call__(self, value: float) -> float:
        return self.first + (value - self._low) * self._scale


def _axes(
    x: _Axis,
    y: _Axis,
    x_ticks: list[tuple[float, str]],
    y_ticks: list[tuple[float, str]],
    x_label: str,
    y_label: str,
) -> list[str]:
    bottom = y.first
    parts = [
        f'<path d="M{x.first:.1f},{y.last:.1f} V{bottom:.1f} H{x.last:.1f}" fill="none" stroke="#000000"/>',
        _text((x.first + x.last) / 2, HEIGHT - 8, x_label, "middle"),
        f'<text transform="translate(14,{(y.first + y.last) / 2:.1f}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>",
    ]
    for value, name in x_ticks:
        parts.append(_text(x(value), bottom + 16, name, "middle"))
    for value, name in y_ticks:
        parts.append(_text(x.first - 5, y(value) + 4, name, "end"))
        parts.append(f'<path d="M{x.first - 3:.1f},{y(value):.1f} h3" stroke="#000000"/>')
    return parts


def _legend(names: list[str], left: float = WIDTH - 120) -> list[str]:
    parts = []
    for k, (name, color) in enumerate(zip(names, COLORS, strict=False)):
        parts.append(f'<rect x="{left:.1f}" y="{TOP + 15 * k - 8}" width="9" height="9" fill="{color}"/>')
        parts.append(_text(left + 14, TOP + 15 * k, name, "start"))
    return parts


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _document(title: str, body: list[str]) -> str:
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'font-family="sans-serif" font-size="11">\n<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>\n'
    )
    return head + "\n".join([_text(WIDTH / 2, 20, title, "middle"), *body]) + "\n</svg>\n"
