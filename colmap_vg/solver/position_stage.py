"""Stage 3 of the solver: positions from baseline lengths, from directions alone, or by the method in the options."""

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.baseline_lengths import (
    connects_all,
    estimate_baseline_ratios,
    positions_by_lengths,
    solve_lengths,
)
from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.errors import GraphError
from colmap_vg.options import SolveOptions
from colmap_vg.pose_graph.alternation import solve_joint
from colmap_vg.positions.bata import solve_bata
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.cross import solve_cross
from colmap_vg.positions.direct import solve_cle1
from colmap_vg.positions.fixed_point import solve_fixed_point
from colmap_vg.positions.lud import solve_lud
from colmap_vg.positions.orthogonal import solve_orthogonal
from colmap_vg.positions.result import PositionResult
from colmap_vg.positions.robust_directions import position_deviations, solve_robust_directions
from colmap_vg.positions.shapefit import solve_shapefit
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import ImageVerdict
from colmap_vg.solver.edge_weights import edge_weights
from colmap_vg.solver.part_poses import PartPoses, world_directions
from colmap_vg.solver.state import MIN_PART_IMAGES, SolverState

Array = NDArray[np.float64]

ROUGH_ITERATIONS = 20
"""Maximum number of outer iterations of Alg. 2 before the epipolar adjustment."""
MAX_DEVIATION = 0.1
"""Largest standard deviation of a position determined by directions alone, as a share of the scene's median radius;
five standard deviations are half of it."""
MAX_SHARE_REMOVED, MAX_REMOVAL_ROUNDS = 0.1, 20
"""Maximum fraction of images removed per round, and number of rounds. An uncertain image makes its neighbours seem
uncertain, so images with less than a third of the largest deviation are not removed in the same round."""
_BASELINES = {
    "bata": solve_bata,
    "cle1": solve_cle1,
    "cross": solve_cross,
    "lud": solve_lud,
    "orthogonal": solve_orthogonal,
    "shapefit": solve_shapefit,
}
_METRICS_OF_FIXED_POINT: dict[str, Literal["C", "O"]] = {"1C": "C", "1O": "O"}
_METRICS_OF_ALTERNATION: dict[str, Literal["C", "O"]] = {"2C": "C", "2O": "O", "2W": "O"}


def place_by_lengths(
    state: SolverState, part: Subgraph, problem: EpipolarProblem, poses: PartPoses, options: SolveOptions
) -> PartPoses:
    """Solve for positions from directions and baseline lengths; initialise by Alg. 2O if lengths do not connect all."""
    graph, rows, n = state.graph, part.edge_rows, part.num_images
    ratios = estimate_baseline_ratios(
        problem, graph.cam2_from_cam1_rotations[rows], graph.cam2_in_cam1_directions[rows]
    )
    lengths = solve_lengths(len(rows), ratios)
    start = None
    if not connects_all(n, part.edges, np.isfinite(lengths)):
        # The epipolar adjustment follows, so that a rough solution of Alg. 2 suffices.
        rough = replace(options, method="2O", max_num_iterations=ROUGH_ITERATIONS, convergence_tolerance=1e-3)
        poses = place_by_method(state, part, poses, rough)
        start = poses.centers
    directions = world_directions(graph, part, poses.rotations)
    return replace(poses, centers=positions_by_lengths(n, part.edges, directions, lengths, start))


def place_by_directions(
    state: SolverState, part: Subgraph, poses: PartPoses, start: Array | None, options: SolveOptions
) -> tuple[Subgraph, PartPoses]:
    """Solve for positions by a robust fit of the directions; remove images of uncertain position, the worst first.

    Without initial positions `start` (k, 3), those of Alg. 1C are taken.
    """
    whole = part
    for rounds_left in reversed(range(MAX_REMOVAL_ROUNDS + 1)):
        n, rotations = part.num_images, poses.rotations[whole.rows_of(part.images)]
        directions = world_directions(state.graph, part, rotations)
        weights = edge_weights(state.graph, part.edge_rows, options)
        if start is None:
            start = solve_cls(n, part.edges, directions, weights).projection_centers
            start = solve_fixed_point(n, part.edges, directions, start, "C", weights, tolerance=1e-3).projection_centers
        solved = solve_robust_directions(n, part.edges, directions, start, weights)
        state.log.extend(solved.positions.log)
        centers = solved.positions.projection_centers
        deviations = position_deviations(n, part.edges, solved, options.random_seed)
        radius = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
        uncertain = deviations > MAX_DEVIATION * radius
        if not uncertain.any() or rounds_left == 0:
            break
        worst = max(np.quantile(deviations, 1.0 - MAX_SHARE_REMOVED), deviations.max() / 3.0)
        removed = uncertain & (deviations >= worst)
        smaller = state.without(part, removed, ImageVerdict.UNCERTAIN, options.random_seed)
        if smaller.num_images < MIN_PART_IMAGES:
            break
        part, start = smaller, centers[part.rows_of(smaller.images)]
    if uncertain.any():
        state.caveats.append(f"{int(uncertain.sum())} of {n} positions are uncertain: {ImageVerdict.UNCERTAIN.reason}.")
    return part, PartPoses(rotations, centers, poses.focal_scales, solved.positions.converged)


def place_by_method(state: SolverState, part: Subgraph, poses: PartPoses, options: SolveOptions) -> PartPoses:
    """Solve for positions, or positions and rotations, by the method in the options."""
    directions = world_directions(state.graph, part, poses.rotations)
    weights = edge_weights(state.graph, part.edge_rows, options)
    if options.method in _BASELINES:
        return _with_positions(
            state, poses, _BASELINES[options.method](part.num_images, part.edges, directions, weights)
        )
    start = solve_cls(part.num_images, part.edges, directions, weights)
    if options.method == "cls":
        return _with_positions(state, poses, start)
    poses = _with_positions(state, poses, start)
    if options.method in _METRICS_OF_FIXED_POINT:
        return _by_fixed_point(state, part, poses, directions, weights, options)
    return _by_alternation(state, part, poses, weights, options)


def _with_positions(state: SolverState, poses: PartPoses, found: PositionResult) -> PartPoses:
    state.log.extend(found.log)
    return replace(poses, centers=found.projection_centers, converged=found.converged)


def _by_fixed_point(
    state: SolverState, part: Subgraph, poses: PartPoses, directions: Array, weights: Array, options: SolveOptions
) -> PartPoses:
    """Solve for positions at given rotations by Alg. 1."""
    found = solve_fixed_point(
        part.num_images,
        part.edges,
        directions,
        poses.centers,
        _METRICS_OF_FIXED_POINT[options.method],
        weights,
        accelerate=options.accelerate,
        max_num_iterations=options.max_num_iterations,
        tolerance=options.convergence_tolerance,
    )
    return _with_positions(state, poses, found)


def _by_alternation(
    state: SolverState, part: Subgraph, poses: PartPoses, weights: Array, options: SolveOptions
) -> PartPoses:
    """Solve for positions and rotations by Alg. 2; 2W uses information matrices and robust weights."""
    graph, informed, information = state.graph, options.method == "2W", None
    if informed:
        if graph.edge_information is None:
            raise GraphError(
                "method 2W needs information matrices of edges, and the graph has none: read it from a database, set"
                " ViewGraph.edge_information, or solve with method 2C or 2O"
            )
        information = graph.edge_information[part.edge_rows]
        information = information / np.median(information[:, 3, 3])
    found = solve_joint(
        part.num_images,
        part.edges,
        graph.cam2_from_cam1_rotations[part.edge_rows],
        graph.cam2_in_cam1_directions[part.edge_rows],
        poses.rotations,
        poses.centers,
        _METRICS_OF_ALTERNATION[options.method],
        None if informed else weights,
        information=information,
        robust=informed,
        accelerate=options.accelerate,
        max_num_iterations=options.max_num_iterations,
        tolerance=options.convergence_tolerance,
    )
    state.log.extend(found.log)
    return replace(
        poses,
        rotations=found.cam_from_world_rotations,
        centers=found.projection_centers,
        converged=found.converged,
    )
