"""Table 1: errors of positions of each method on each set, with m and n after 1DSfM.

The default method is solved by its own chain, which may register other images. What compares it with the others is over
the images that all of them register (:func:`with_shared_medians`).
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_vg.metrics import position_errors, rotation_errors
from colmap_vg.options import Method, SolveOptions
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import SolutionStatus
from colmap_vg.solver.solve import solve_view_graph
from paper.markdown import markdown_table
from paper.scenes import KnownScene

PAPER_METHODS: tuple[Method, ...] = ("cross", "cls", "shapefit", "lud", "bata", "1C", "1O", "2C", "2O")
DEFAULT_METHOD: Method = "epipolar"
"""The library's own, which is no method of the paper: it is never in Table 1."""
TABLE_METHODS: tuple[Method, ...] = (*PAPER_METHODS, DEFAULT_METHOD)
EARLIER_METHODS = ("cls", "cross")
"""What the paper's methods are to beat."""
MIN_ALIGNED = 3
"""Images that determine a similarity."""
TABLE_TOLERANCE, TABLE_ITERATIONS = 1e-4, 300
"""Relative change of positions at which outer iterations end, and their limit: errors are printed to three digits."""


@dataclass(frozen=True)
class MethodErrors:
    """What one method reached on one scene.

    Attributes
    ----------
    dataset : str
    seed : int
    method : str
    num_edges, num_images : int
        m and n that the method solved with, after 1DSfM.
    rms, mean, median : float
        Errors of positions in the truth's unit, after the best similarity over the solved images with truth; infinite
        where fewer than three were solved.
    rotation_median_deg : float
    num_iterations : int
        Lines in the iteration log of the method's own stage.
    converged : bool
        Whether the solution is neither doubtful nor short of convergence.
    seconds : float
        Of the whole chain.
    shared_median : float
        Median error over the images that the default and every other method register, after the best similarity over
        them; infinite where they are fewer than three, NaN where the default was not among the methods.
    """

    dataset: str
    seed: int
    method: str
    num_edges: int
    num_images: int
    rms: float
    mean: float
    median: float
    rotation_median_deg: float
    num_iterations: int
    converged: bool
    seconds: float
    shared_median: float = float("nan")


def paper_options(method: Method, seed: int = 0) -> SolveOptions:
    """The paper's chain: chordal rotation averaging, no gate, 1DSfM, equal weights."""
    return SolveOptions(
        method=method,
        rotation_averaging="chordal",
        rotation_gate_deg=0.0,
        outlier_filter="1dsfm",
        edge_weights="unit",
        convergence_tolerance=TABLE_TOLERANCE,
        max_num_iterations=TABLE_ITERATIONS,
        random_seed=seed,
    )


def table_options(method: Method, seed: int = 0) -> SolveOptions:
    """The paper's chain for its methods, the default options for the default method."""
    return SolveOptions(random_seed=seed) if method == DEFAULT_METHOD else paper_options(method, seed)


def solve_with(scene: KnownScene, method: Method, seed: int) -> tuple[PoseSolution, MethodErrors]:
    """Solve a scene by a method's chain (:func:`table_options`) and measure the result.

    Parameters
    ----------
    scene : KnownScene
    method : str
        A method of `SolveOptions`.
    seed : int
        Of the scene, and of 1DSfM's lines.

    Returns
    -------
    PoseSolution
    MethodErrors
    """
    begin = time.perf_counter()
    solution = solve_view_graph(scene.graph, table_options(method, seed))
    seconds = time.perf_counter() - begin
    rows = solution.registered & scene.known
    rms = mean = median = turned = float("inf")
    if rows.sum() >= MIN_ALIGNED:
        errors = position_errors(solution.projection_centers[rows], scene.projection_centers[rows])
        rms, mean, median = errors.rms, errors.mean, errors.median
        turned = rotation_errors(
            solution.cam_from_world_rotations[rows], scene.cam_from_world_rotations[rows]
        ).median_deg
    return solution, MethodErrors(
        dataset=scene.name,
        seed=seed,
        method=method,
        num_edges=int(solution.edge_kept.sum()),
        num_images=int(solution.registered.sum()),
        rms=rms,
        mean=mean,
        median=median,
        rotation_median_deg=turned,
        num_iterations=sum(entry.stage == method for entry in solution.log),
        converged=solution.status in (SolutionStatus.SOLVED, SolutionStatus.PARTIAL),
        seconds=seconds,
    )


def with_shared_medians(
    scene: KnownScene, solved: Mapping[Method, tuple[PoseSolution, MethodErrors]]
) -> tuple[MethodErrors, ...]:
    """Errors of each method of a scene with their `shared_median`, as they are without the default among them."""
    rows = tuple(row for _, row in solved.values())
    if DEFAULT_METHOD not in solved:
        return rows
    shared = scene.known & np.all([solution.registered for solution, _ in solved.values()], axis=0)
    if shared.sum() < MIN_ALIGNED:
        return tuple(replace(row, shared_median=float("inf")) for row in rows)
    truth = scene.projection_centers[shared]
    return tuple(
        replace(row, shared_median=position_errors(solution.projection_centers[shared], truth).median)
        for solution, row in solved.values()
    )


def median_over_seeds(rows: Sequence[MethodErrors]) -> list[MethodErrors]:
    """One row for each set and method, in the order of their first rows: medians over seeds; converged where all did.

    The row's `seed` is the number of seeds.
    """
    groups: dict[tuple[str, str], list[MethodErrors]] = {}
    for row in rows:
        groups.setdefault((row.dataset, row.method), []).append(row)

    def middle(group: list[MethodErrors], name: str) -> float:
        return float(np.median([getattr(row, name) for row in group]))

    return [
        MethodErrors(
            dataset=dataset,
            seed=len(group),
            method=method,
            num_edges=round(middle(group, "num_edges")),
            num_images=round(middle(group, "num_images")),
            rms=middle(group, "rms"),
            mean=middle(group, "mean"),
            median=middle(group, "median"),
            rotation_median_deg=middle(group, "rotation_median_deg"),
            num_iterations=round(middle(group, "num_iterations")),
            converged=all(row.converged for row in group),
            seconds=middle(group, "seconds"),
            shared_median=middle(group, "shared_median"),
        )
        for (dataset, method), group in groups.items()
    ]


def table_1(rows: Sequence[MethodErrors]) -> str:
    """Markdown of Table 1 from rows of all sets, seeds and methods: RMS, mean, median; the best of a set is bold."""
    middle = median_over_seeds(rows)
    methods = list(dict.fromkeys(row.method for row in middle))
    table = []
    for dataset in dict.fromkeys(row.dataset for row in middle):
        cells = {row.method: row for row in middle if row.dataset == dataset}
        first = next(iter(cells.values()))
        best = [min(getattr(row, name) for row in cells.values()) for name in ("rms", "mean", "median")]
        line = [dataset.replace("_", " "), str(first.seed), str(first.num_edges), str(first.num_images)]
        for method in methods:
            row = cells.get(method)
            if row is None:
                line.append("")
                continue
            values = zip((row.rms, row.mean, row.median), best, strict=True)
            shown = [f"**{value:.3g}**" if value == least else f"{value:.3g}" for value, least in values]
            line.append(" / ".join(shown) + ("" if row.converged else " †"))
        table.append(line)
    return markdown_table(["set", "seeds", "m", "n", *methods], table)


def wins(rows: Sequence[MethodErrors], rivals: Sequence[str] = EARLIER_METHODS) -> str:
    """Markdown: on how many sets each method's median error is below that of every rival."""
    middle = median_over_seeds(rows)
    medians = {(row.dataset, row.method): row.median for row in middle}
    datasets = list(dict.fromkeys(row.dataset for row in middle))
    methods = [method for method in dict.fromkeys(row.method for row in middle) if method not in rivals]
    table = []
    for method in methods:
        tested = [d for d in datasets if all((d, name) in medians for name in (method, *rivals))]
        won = [d for d in tested if all(medians[d, method] < medians[d, rival] for rival in rivals)]
        best = [d for d in tested if medians[d, method] == min(v for (name, _), v in medians.items() if name == d)]
        lost = ", ".join(d.replace("_", " ") for d in tested if d not in won) or "none"
        table.append([method, f"{len(won)} of {len(tested)}", str(len(best)), lost])
    return markdown_table(["method", f"better than {' and '.join(rivals)}", "best of all", "not better on"], table)
