"""All tables and figures of the paper in one folder, whole or not at all.

Each scene is measured by itself (:func:`measure_scene`), in any process; what it found is kept as a file of numbers
under ``OUT/.work``, so that a long job can be taken up again.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, astuple, dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg._version import __version__
from colmap_vg.errors import OutputError
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.options import Method
from colmap_vg.simulation.six_vertices import SIX_CENTERS, SIX_EDGES
from paper.figures import EdgeErrors, edge_errors, scale_factors, shares_outside
from paper.markdown import csv_text, markdown_table
from paper.noise_ratios import NOISE_RATIOS, NUM_RATIO_SEEDS, ROTATION_DEG, errors_by_ratio
from paper.plots import bars_svg, histogram_svg, lines_svg, points_svg
from paper.position_table import MethodErrors, solve_with, table_1, wins
from paper.scenes import KnownScene, real_scene, set_conditions, simulated_scene

Array = NDArray[np.float64]

TABLES_NAME = "tables"
SCALE_BINS = np.linspace(-2.0, 2.0, 81)
"""log10 of scale factor over length."""
ERROR_BINS = np.linspace(0.0, 180.0, 61)
"""Degrees."""
CONVERGED_LOG_RATIO = 0.01
"""|log10 lambda / length| below which scale factor and length agree."""


@dataclass(frozen=True)
class SceneJob:
    """One scene to be measured.

    Attributes
    ----------
    dataset : str
        Set of the topology folder, or name of the 1DSfM folder.
    folder : str
        The topology folder, or the 1DSfM folder itself.
    seed : int or None
        None for real edges.
    methods : tuple of str
    """

    dataset: str
    folder: str
    seed: int | None
    methods: tuple[Method, ...]

    def scene(self) -> KnownScene:
        """Read or simulate the scene."""
        if self.seed is None:
            return real_scene(self.folder)
        return simulated_scene(self.folder, self.dataset, self.seed)

    @property
    def key(self) -> str:
        """Name of its file of numbers: another for any other input, option, version or noise."""
        conditions = None if self.seed is None else set_conditions(self.folder, self.dataset)
        told = json.dumps([__version__, asdict(self), conditions and [conditions[0], asdict(conditions[1])]])
        return f"{self.dataset}-{self.seed}-{hashlib.sha256(told.encode()).hexdigest()[:12]}.json"


@dataclass(frozen=True)
class SceneReport:
    """What one scene adds to the tables and figures: plain numbers.

    Attributes
    ----------
    rows : tuple of MethodErrors
    scale_counts : dict of "CLS" or "1C" to list of int
        Edges in :data:`SCALE_BINS`; those beyond are in the outermost.
    cls_share_at_one : float
        Edges whose scale factor CLS leaves at exactly 1.
    alg_1c_share_off : float
        Edges whose scale factor differs from the length by a hundredth of a decade or more in 1C.
    error_counts : dict of name to list of int
        Edges in :data:`ERROR_BINS`, by rotation and direction, all and kept.
    """

    rows: tuple[MethodErrors, ...]
    scale_counts: dict[str, list[int]]
    cls_share_at_one: float
    alg_1c_share_off: float
    error_counts: dict[str, list[int]]


def measure_scene(job: SceneJob) -> SceneReport:
    """Solve a scene by all methods of its job and count what the figures show.

    Raises
    ------
    ColmapVgError
        The scene's files are missing or bad, or the scene cannot be solved.
    """
    scene, seed = job.scene(), job.seed or 0
    rows = tuple(solve_with(scene, method, seed)[1] for method in job.methods)
    front, _ = solve_with(scene, "cls", seed)
    factors = scale_factors(scene.graph, front)
    return SceneReport(
        rows,
        {"CLS": _counts(factors.cls, SCALE_BINS), "1C": _counts(factors.alg_1c, SCALE_BINS)},
        factors.cls_share_at_one,
        float(np.mean(np.abs(factors.alg_1c) >= CONVERGED_LOG_RATIO)),
        _error_counts(edge_errors(scene, front)),
    )


def measure_or_load(job: SceneJob, work: str | PathLike[str], resume: bool) -> SceneReport:
    """:func:`measure_scene`, kept in a folder; with `resume`, taken from there where it is."""
    path = Path(work) / job.key
    if resume and path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        return SceneReport(tuple(MethodErrors(*row) for row in found.pop("rows")), **found)
    report = measure_scene(job)
    kept = {**asdict(report), "rows": [astuple(row) for row in report.rows]}
    draft = path.with_suffix(".draft")
    draft.write_text(json.dumps(kept), encoding="utf-8")
    draft.replace(path)
    return report


def write_tables(
    output_path: str | PathLike[str],
    reports: Sequence[SceneReport],
    *,
    six_vertex_methods: Sequence[Method],
    num_draws: int = 500,
    num_ratio_seeds: int = NUM_RATIO_SEEDS,
    overwrite: bool = False,
) -> Path:
    """Write Markdown, CSV and SVG to ``output_path/tables``, whole or not at all.

    Parameters
    ----------
    output_path : path
    reports : sequence of SceneReport
        Of all sets and seeds; a set's figures add up over its seeds.
    six_vertex_methods : sequence of str
        Methods of Fig. 4 and of the noise ratios; none leaves them out.
    num_draws : int
        Draws of Fig. 4.
    num_ratio_seeds : int
        Simulations at each ratio of noises.
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
    files.update(_scale_files(reports))
    if six_vertex_methods:
        files.update(_six_vertex_files(six_vertex_methods, num_draws))
        files.update(_ratio_files(six_vertex_methods, num_ratio_seeds))
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
    rows = [row for report in reports for row in report.rows]
    yield (
        "table1.md",
        "## Table 1: errors of positions\n\nRMS / mean / median in the truth's unit after the best similarity; m edges"
        " and n images after 1DSfM; medians over seeds. † not converged, or doubtful,"
        " on some seed.\n\n"
        f"{table_1(rows)}\n{wins(rows)}\n",
    )
    yield "table1.csv", csv_text(rows, MethodErrors)


def _scale_files(reports: Sequence[SceneReport]) -> Iterator[tuple[str, str]]:
    table = []
    for dataset, group in _by_set(reports).items():
        at_one = np.mean([report.cls_share_at_one for report in group])
        off = np.mean([report.alg_1c_share_off for report in group])
        table.append([dataset.replace("_", " "), f"{100 * at_one:.1f} %", f"{100 * off:.3g} %"])
        counts = {name: _sum([report.scale_counts[name] for report in group]) for name in ("CLS", "1C")}
        title = f"{dataset.replace('_', ' ')}: scale factors against lengths"
        yield f"fig2_{dataset}.svg", histogram_svg(title, "log10 lambda / |p_i - p_j|", SCALE_BINS, counts)
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


def _ratio_files(methods: Sequence[Method], num_seeds: int) -> Iterator[tuple[str, str]]:
    errors = errors_by_ratio(methods, num_seeds)
    best = np.min(list(errors.values()), axis=0)
    table = [
        [
            method,
            *(f"**{e:.3g}**" if e == least else f"{e:.3g}" for e, least in zip(100.0 * row, 100.0 * best, strict=True)),
        ]
        for method, row in errors.items()
    ]
    text = markdown_table(["method", *(f"{ratio:g}" for ratio in NOISE_RATIOS)], table)
    yield (
        "ratios.md",
        "## Which method at which ratio of noises\n\nMedian error in percent of the radius of a ring, by the standard"
        f" deviation of directions over that of rotations ({ROTATION_DEG:g}° in each axis), no outliers; medians over"
        f" {num_seeds} rings.\n\n{text}\n",
    )
    series = {method: (np.array(NOISE_RATIOS), 100.0 * row) for method, row in errors.items()}
    label = "noise of directions / noise of rotations"
    yield "ratios.svg", lines_svg("Accuracy by ratio of noises", label, "median error, % of radius", series)


_WHEN = ("before", "after")


def _share_over(counts: Array, degrees: float = 30.0) -> str:
    over = counts[ERROR_BINS[:-1] >= degrees].sum() / max(counts.sum(), 1.0)
    return f"{100 * over:.1f} %"


def _error_counts(errors: EdgeErrors) -> dict[str, list[int]]:
    counts = {}
    for what, values in (("rotation", errors.rotation_deg), ("direction", errors.direction_deg)):
        known = np.isfinite(values)
        counts[f"{what} before"] = _counts(values[known], ERROR_BINS)
        counts[f"{what} after"] = _counts(values[known & errors.kept], ERROR_BINS)
    return counts


def _counts(values: Array, bins: Array) -> list[int]:
    inside = np.clip(values, bins[0], bins[-1])
    return [int(count) for count in np.histogram(inside, bins)[0]]


def _sum(counts: Sequence[Sequence[int]]) -> Array:
    return np.asarray(np.sum(np.asarray(counts, dtype=float), axis=0))


def _by_set(reports: Sequence[SceneReport]) -> dict[str, list[SceneReport]]:
    groups: dict[str, list[SceneReport]] = {}
    for report in reports:
        groups.setdefault(report.rows[0].dataset, []).append(report)
    return groups
