"""Stage 4 of the solver: epipolar adjustment of poses and free intrinsics, and removal of remaining outlier pairs."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import AdjustmentResult, adjust_epipolar, edge_errors
from colmap_vg.epipolar.covariance import NUM_DRAWS, camera_covariances
from colmap_vg.epipolar.problem import EpipolarProblem, epipolar_problem, focal_groups
from colmap_vg.epipolar.radial_term import fit_radial_term
from colmap_vg.options import SolveOptions
from colmap_vg.scene.edge_residuals import edge_residual_sigmas
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.direction_stage import fixed_part
from colmap_vg.solver.part_poses import PartPoses
from colmap_vg.solver.state import SolverState

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SMALL_ANGLE_DEG = 1.5
"""Median triangulation angle of a part's pairs below which the uncertainty of its positions is estimated, degrees."""
FEW_DRAWS = 16
"""Number of noise samples if covariances are not asked for."""
MAX_POSITION_SIGMA = 0.02
"""Median standard deviation of positions over their root mean square distance from the centroid above which they are
hardly known. Simulated cameras on a tripod had 0.02 to 0.2, with errors of 0.04 to 0.4; photographs 0.002 at most."""
CONTRADICTION = 10.0
"""Residual of a pair, in standard deviations, over that of the median pair, above which it is an outlier. Errors common
to all pairs, such as unmodelled distortion, are in the median; noise of a single pair does not reach five."""
MISFIT, MISFIT_PX = 3.0, 1.0
"""Median error of an outlier pair's matches at the adjusted cameras: least multiple of that of the median pair, and
least value in pixels."""


def adjust_poses(
    state: SolverState, part: Subgraph, problem: EpipolarProblem, poses: PartPoses, options: SolveOptions
) -> tuple[Subgraph, PartPoses]:
    """Adjust poses and free focal lengths to the matches; return the remaining part and its poses.

    Reversed edges and outliers are dropped, and images whose positions the remaining edges do not determine.
    """
    directions = state.graph.cam2_in_cam1_directions[part.edge_rows]
    tolerance = options.adjustment_tolerance
    found = adjust_epipolar(problem, poses.rotations, poses.centers, directions, tolerance=tolerance)
    state.log.extend(found.log)
    problem, found = _with_radial_term(state, problem, found, directions, tolerance)
    state.drop(part.edge_rows[found.reversed_edges], EdgeVerdict.REVERSED)
    dropped = found.reversed_edges.copy()
    if problem.bent_cameras is None:  # relative poses from distorted rays are not comparable with those without
        dropped |= _contradicting(state, part, problem, found)
    if dropped.sum() > found.reversed_edges.sum():
        state.drop(part.edge_rows[dropped & ~found.reversed_edges], EdgeVerdict.CONTRADICTS_POSES)
        rest = problem.without(dropped)
        kept = part.with_edges(~dropped)
        if state.largest_rigid_part(kept, options.random_seed).num_images < part.num_images:
            # Tracks that were not needed before may determine the remaining positions.
            rest = epipolar_problem(state.graph, kept, options) or rest
        free = problem.free_focals & ~found.lost_focals
        rest = replace(rest, free_focals=free, bent_cameras=problem.bent_cameras)
        again = adjust_epipolar(
            rest,
            found.cam_from_world_rotations,
            found.projection_centers,
            directions[~dropped],
            initial_lenses=found.cameras.lenses,
            scales_px=(found.scale_px,),
            final_sigmas=0.0,
            tolerance=tolerance,
        )
        state.log.extend(again.log)
        state.drop(part.edge_rows[~dropped][again.reversed_edges], EdgeVerdict.REVERSED)
        problem, lost = rest, found.lost_focals | again.lost_focals
        found = replace(again, lost_focals=lost)
    group = focal_groups(state.graph)[0]
    if found.lost_focals.any():
        count = int(found.lost_focals[group].sum())
        state.caveats.append(
            f"The matches do not determine the focal length of {count} of {len(group)} cameras; it is left as read."
        )
    fixed = fixed_part(state, part, options) if dropped.any() else part
    rows = part.rows_of(fixed.images)
    solved = PartPoses(
        found.cam_from_world_rotations[rows],
        found.projection_centers[rows],
        found.focal_scales[group],
        found.converged,
        radial_terms=_radial_terms(problem, found, group),
    )
    moved_little = _median_angle_deg(state.graph, fixed) < SMALL_ANGLE_DEG
    if options.covariances or moved_little:
        draws = NUM_DRAWS if options.covariances else FEW_DRAWS
        known = camera_covariances(problem, found, seed=options.random_seed, num_draws=draws)
        if moved_little:
            _warn_of_uncertain(state, fixed, solved.centers, known.positions[rows])
        if options.covariances:
            solved = replace(solved, covariances=(known.positions[rows], known.rotations[rows]))
    return fixed, solved


def _median_angle_deg(graph: ViewGraph, part: Subgraph) -> float:
    """Median triangulation angle of a part's pairs, degrees; infinite where it is unknown."""
    if graph.triangulation_angles is None or not len(part.edge_rows):
        return np.inf
    return float(np.degrees(np.median(np.nan_to_num(graph.triangulation_angles[part.edge_rows], nan=np.inf))))


def _warn_of_uncertain(state: SolverState, part: Subgraph, centers: Array, covariances: Array) -> None:
    """Mark the images of a part whose positions (k, 3) are uncertain by a large share of their extent."""
    extent = np.sqrt(np.square(centers - centers.mean(axis=0)).sum(axis=1).mean())
    share = float(np.sqrt(np.median(np.trace(covariances, axis1=1, axis2=2))) / extent)
    if share <= MAX_POSITION_SIGMA:
        return
    state.note_uncertain(
        part.images,
        f"The positions of {part.num_images} images are uncertain by {share:.0%} of their extent: between them the"
        " camera moved too little for the distance of what it saw.",
    )


def _with_radial_term(
    state: SolverState, problem: EpipolarProblem, found: AdjustmentResult, directions: Array, tolerance: float
) -> tuple[EpipolarProblem, AdjustmentResult]:
    """Estimate a radial term if focal lengths are free; return the problem, with the term if there is one, solved."""
    graph, (group, first) = state.graph, focal_groups(state.graph)
    free = problem.free_focals & ~found.lost_focals
    if graph.camera_radial is None or not free.any():
        return problem, found
    free_radials = free & (np.bincount(group, weights=~graph.camera_radial, minlength=len(first)) == 0)
    lens = fit_radial_term(problem, found, free_radials) if free_radials.any() else None
    if lens is None:
        return problem, found
    start = lens.result
    again = adjust_epipolar(
        lens.problem,
        start.cam_from_world_rotations,
        start.projection_centers,
        directions,
        initial_lenses=start.cameras.lenses,
        scales_px=(start.scale_px,),
        near=True,
        tolerance=tolerance,
    )
    state.log.extend(again.log)
    return lens.problem, again


def _radial_terms(problem: EpipolarProblem, found: AdjustmentResult, group: IntArray) -> Array | None:
    """Radial terms (c,) of the graph's cameras at their focal lengths; None without."""
    if problem.bent_cameras is None:
        return None
    return np.asarray(np.where(problem.bent_cameras, found.radial_term * np.square(found.focal_scales), 0.0)[group])


def _contradicting(state: SolverState, part: Subgraph, problem: EpipolarProblem, found: AdjustmentResult) -> BoolArray:
    """Mask (e,) of a part's edges whose relative poses and matches are outliers at the adjusted cameras."""
    graph, rows = state.graph, part.edge_rows
    if graph.edge_information is None:
        return np.zeros(len(rows), dtype=bool)
    sigmas = edge_residual_sigmas(
        part.edges,
        graph.cam2_from_cam1_rotations[rows],
        graph.cam2_in_cam1_directions[rows],
        graph.edge_information[rows],
        found.cam_from_world_rotations,
        found.projection_centers,
    )
    contradicting = (sigmas > CONTRADICTION * max(float(np.median(sigmas)), 1.0)) & ~state.trusted[rows]
    if contradicting.any():
        # A pose alone is no evidence: it may be the wrong one of two that nearly explain the matches of a plane.
        errors = edge_errors(problem, found)
        contradicting &= errors > max(MISFIT * float(np.median(errors)), MISFIT_PX)
    return np.asarray(contradicting)
