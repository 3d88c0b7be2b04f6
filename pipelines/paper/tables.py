"""All tables and figures of the paper in one folder, whole or not at all, from what was measured on each scene."""

import shutil
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import OutputError
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.options import Method
from colmap_vg.simulation.six_vertices import SIX_CENTERS, SIX_EDGES
from paper.default_table import default_table, times_table
from paper.figures import shares_outside
from paper.markdown import csv_text, markdown_table
from paper.noise_ratios import (
    NOISE_RATIOS,
    NUM_RATIO_SEEDS,
    ROTATION_DEG,
    errors_by_ratio,
    ratio_table,
    real_edges_text,
)
from paper.plots import bars_svg, histogram_svg, histograms_svg, lines_svg, points_svg
from paper.position_table import DEFAULT_METHOD, MethodErrors, table_1, wins
from paper.real_edges import EdgeNoise
from paper.scene_reports import ERROR_BINS, SCALE_BINS, SceneReport

Array = NDArray[np.float64]

TABLES_NAME = "tables"
SCALE_LABEL = "log10 lambda / |p_i - p_j|"


def write_tables(
    output_path: str | PathLike[str],
    reports: Sequence[SceneReport],
    *,
    six_vertex_methods: Sequence[Method],
    num_draws: int = 500,
    num_ratio_seeds: int = NUM_RATIO_SEEDS,
    real_edges: Sequence[EdgeNoise] = (),
    overwrite: bool = False,
) -> Path:
    """Write Markdown, CSV and SVG to ``output_path/tables``, whole or not at all.

    Parameters
    ----------
    output_path : path
    reports : sequence of SceneReport
        Of all sets and seeds; a set's figures add up over its seeds.
    six_vertex_methods : sequence of str
        Methods of Fig. 4 and of the noise ratios, without the default; none leaves them out.
    num_draws : int
        Draws of Fig. 4.
    num_ratio_seeds : int
        Simulations at each ratio of noises.
    real_edges : sequence of EdgeNoise
        Noise of real edges, shown among the ratios.
    overwrite : bool
        Replace tables that are there already.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OutputError
        Tables are there already, or the folder cannot be written.
    """
    output = Path(output_path)
    refuse_tables(output, overwrite)
    files = dict(_position_files(reports))
    files.update(_default_files(reports))
    files.update(_scale_files(reports))
    if six_vertex_methods:
        files.update(_six_vertex_files(six_vertex_methods, num_draws))
        files.update(_ratio_files(six_vertex_methods, num_ratio_seeds, real_edges))
    files.update(_error_files(reports))
    files = {"tables.md": "".join(text for name, text in files.items() if name.endswith(".md")), **files}
    draft, target = output / ".work" / TABLES_NAME, output / TABLES_NAME
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        for name, text in files.items():
            if name == "tables.md" or not name.endswith(".md"):
                (draft / name).write_text(text, encoding="utf-8")
        if target.exists():
            replaced = output / ".work" / "replaced"
            shutil.rmtree(replaced, ignore_errors=True)
            target.rename(replaced)
        draft.rename(target)
        shutil.rmtree(output / ".work" / "replaced", ignore_errors=True)
    except OSError as error:
        raise OutputError(f"cannot write the tables to {output}: {error.strerror} ({error.filename})") from error
    return target


def refuse_tables(output_path: str | PathLike[str], overwrite: bool) -> None:
    """Raise `OutputError` when the folder holds tables that must not be replaced."""
    target = Path(output_path) / TABLES_NAME
    if target.exists() and not overwrite:
        raise OutputError(f"{target} is there already: choose another --output_path, or replace it with --overwrite")


def _position_files(reports: Sequence[SceneReport]) -> Iterator[tuple[str, str]]:
    rows = [row for report in reports for row in report.rows if row.method != DEFAULT_METHOD]
    yield (
        "table1.md",
        "## Table 1: errors of positions\n\nRMS / mean / median in the truth's unit after the best similarity; m edges"
        " and n images after 1DSfM; medians over seeds. † not converged, or doubtful,"
        " on some seed.\n\n"
        f"{table_1(rows)}\n{wins(rows)}\n",
    )
    yield "table1.csv", csv_text(rows, MethodErrors)


def _default_files(reports: Sequence[SceneReport]) -> Iterator[tuple[str, str]]:
    rows = [row for report in reports for row in report.rows]
    ours = [row for row in rows if row.method == DEFAULT_METHOD]
    if ours:
        yield (
            "default.md",
            "## The default beside them\n\nThe default options average rotations and filter edges in their own way, and"
            " leave out images of uncertain position. n images of either chain, and median errors over the images that"
            " both register, after the best similarity over these; medians over seeds.\n\n"
            f"{default_table(rows)}\n",
        )
        yield "default.csv", csv_text(ours, MethodErrors)
    num_edges = {report.rows[0].dataset: report.num_edges for report in reports}
    averaging = {(report.rows[0].dataset, report.rows[0].seed): report.averaging_seconds for report in reports}
    yield (
        "times.md",
        "## Times beside pycolmap's rotation averaging\n\nSeconds of `pycolmap.run_rotation_averaging`, and the time of"
        " each method's whole chain, from edges to positions, as a multiple of them: the same graph in the same"
        f" process, medians over seeds.\n\n{times_table(rows, num_edges, averaging)}\n",
    )


def _scale_files(reports: Sequence[SceneReport]) -> Iterator[tuple[str, str]]:
    table, panels = [], {}
    for dataset, group in _by_set(reports).items():
        at_one = np.mean([report.cls_share_at_one for report in group])
        off = np.mean([report.alg_1c_share_off for report in group])
        table.append([dataset.replace("_", " "), f"{100 * at_one:.1f} %", f"{100 * off:.3g} %"])
        counts = {name: _sum([report.scale_counts[name] for report in group]) for name in ("CLS", "1C")}
        panels[dataset.replace("_", " ")] = counts
        title = f"{dataset.replace('_', ' ')}: scale factors against lengths"
        yield f"fig2_{dataset}.svg", histogram_svg(title, SCALE_LABEL, SCALE_BINS, counts)
    yield "fig3.svg", histograms_svg("Scale factors against lengths", SCALE_LABEL, SCALE_BINS, panels)
    text = markdown_table(["set", "CLS: lambda exactly 1", "1C: log10 ratio beyond ± 0.01"], table)
    yield "fig2.md", f"## Fig. 2 and 3: scale factors against lengths\n\nShares of edges.\n\n{text}\n"


def _six_vertex_files(methods: Sequence[Method], num_draws: int) -> Iterator[tuple[str, str]]:
    shares, shown = shares_outside(methods, num_draws)
    text = markdown_table(["method", "inner camera outside"], [[k, f"{100 * v:.1f} %"] for k, v in shares.items()])
    yield "fig4.md", f"## Fig. 4: six vertices, {num_draws} draws of 5°\n\n{text}\n"
    yield "fig4.svg", bars_svg(f"Six vertices, {num_draws} draws of 5°", "share outside", shares)
    placed = {name: align_positions(p, SIX_CENTERS)[1].apply(p)[:, :2] for name, p in shown.items()}
    yield "fig4_positions.svg", points_svg("Six vertices: one draw", SIX_EDGES, SIX_CENTERS[:, :2], placed)


def _error_files(reports: Sequence[SceneReport]) -> Iterator[tuple[str, str]]:
    table = []
    for dataset, group in _by_set(reports).items():
        line = [dataset.replace("_", " ")]
        for what in ("rotation", "direction"):
            before, after = (_sum([report.error_counts[f"{what} {when}"] for report in group]) for when in _WHEN)
            line += [_share_over(before), _share_over(after)]
            title = f"{dataset.replace('_', ' ')}: errors of {what}s"
            yield (
                f"fig5_{dataset}_{what}s.svg",
                histogram_svg(title, "degrees", ERROR_BINS, dict(zip(_WHEN, (before, after), strict=True))),
            )
        table.append(line)
    header = ["set", *(f"{what}s over 30°, {when} 1DSfM" for what in ("rotation", "direction") for when in _WHEN)]
    yield "fig5.md", f"## Fig. 5: errors of edges before and after 1DSfM\n\n{markdown_table(header, table)}\n"


def _ratio_files(
    methods: Sequence[Method], num_seeds: int, real_edges: Sequence[EdgeNoise]
) -> Iterator[tuple[str, str]]:
    errors = errors_by_ratio(methods, num_seeds)
    real = f"{real_edges_text(errors, real_edges)}\n" if real_edges else ""
    yield (
        "ratios.md",
        "## Which method at which ratio of noises\n\nMedian error in percent of the radius of a ring, by the standard"
        f" deviation of directions over that of rotations ({ROTATION_DEG:g}° in each axis), no outliers; medians over"
        f" {num_seeds} rings.\n\n{ratio_table(errors)}\n{real}",
    )
    series = {method: (np.array(NOISE_RATIOS), 100.0 * row) for method, row in errors.items()}
    label, marks = "noise of directions / noise of rotations", {n.name.replace("_", " "): n.ratio for n in real_edges}
    yield "ratios.svg", lines_svg("Accuracy by ratio of noises", label, "median error, % of radius", series, marks)


_WHEN = ("before", "after")


def _share_over(counts: Array, degrees: float = 30.0) -> str:
    over = counts[ERROR_BINS[:-1] >= degrees].sum() / max(counts.sum(), 1.0)
    return f"{100 * over:.1f} %"


def _sum(counts: Sequence[Sequence[int]]) -> Array:
    return np.asarray(np.sum(np.asarray(counts, dtype=float), axis=0))


def _by_set(reports: Sequence[SceneReport]) -> dict[str, list[SceneReport]]:
    groups: dict[str, list[SceneReport]] = {}
    for report in reports:
        groups.setdefault(report.rows[0].dataset, []).append(report)
    return groups
