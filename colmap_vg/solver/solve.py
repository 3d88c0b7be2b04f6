"""Solver of viewing graphs: rotation averaging, outlier filters, positions and refinement.

Nasiri, Hosseini, Moradi, "Solving Viewing Graph Optimization for Simultaneous Position and Rotation Registration",
Alg. 1 and 2, after outlier filters (rotation gate, direction filter, parallel rigidity) and, by default, followed by
the epipolar adjustment. Each stage works on the part of the graph that is still solvable; removed images and edges get
a verdict.

1. :mod:`~colmap_vg.solver.rotation_stage` averages rotations and drops outlier pairs.
2. :mod:`~colmap_vg.solver.direction_stage` selects the part whose positions are determined and drops outlier
   directions.
3. :mod:`~colmap_vg.solver.position_stage` solves for positions.
4. :mod:`~colmap_vg.solver.adjustment_stage` adjusts all cameras to the matches and drops remaining outlier pairs.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.epipolar.problem import epipolar_problem
from colmap_vg.errors import GraphError
from colmap_vg.events import report_progress
from colmap_vg.linear.threads import single_threaded_blas
from colmap_vg.options import SolveOptions
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import ImageVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.adjustment_stage import adjust_poses
from colmap_vg.solver.direction_stage import filter_directions
from colmap_vg.solver.part_poses import PartPoses
from colmap_vg.solver.position_stage import place_by_directions, place_by_lengths, place_by_method
from colmap_vg.solver.rotation_stage import admit_confirmed_pairs, average_rotations
from colmap_vg.solver.state import MIN_PART_IMAGES, SolverState, num_cameras

Array = NDArray[np.float64]


@single_threaded_blas
def solve_view_graph(
    graph: ViewGraph, options: SolveOptions | None = None, initial_rotations: ArrayLike | None = None
) -> PoseSolution:
    """Solve for the rotations and positions of all parts of three or more images that the graph determines.

    Parameters
    ----------
    graph : ViewGraph
    options : SolveOptions, optional
    initial_rotations : (n, 3, 3) array, optional
        cam_from_world rotations that are refined instead of averaging from scratch. They are ignored for a part if they
        are not finite for all its images. Robust averaging only.

    Returns
    -------
    PoseSolution
        In the graph's order of images and edges; the largest part is component 0. For an unsolvable graph no image is
        registered, the status is ``unsolvable`` and the message gives the reason.
    """
    options = SolveOptions.given(options)
    state = SolverState(graph)
    initial = _initial_rotations(graph, initial_rotations)
    unsolved = np.ones(graph.num_images, dtype=bool)
    while True:
        part = state.largest_component(unsolved, ImageVerdict.SMALLER_COMPONENT)
        if part.num_images < MIN_PART_IMAGES:
            state.remove_images(part, ImageVerdict.SMALLER_COMPONENT)
            state.link_by_rigs()
            state.link_by_positions()
            return state.solution()
        solved, poses = _solve_part(state, part, options, initial[part.images])
        if poses is None:
            state.remove_images(solved, ImageVerdict.NOT_RIGID)
        else:
            state.record_poses(
                solved,
                poses.rotations,
                poses.centers,
                poses.focal_scales,
                poses.converged,
                poses.covariances,
                poses.radial_terms,
            )
        unsolved[solved.images] = False


def _solve_part(
    state: SolverState, part: Subgraph, options: SolveOptions, initial: Array
) -> tuple[Subgraph, PartPoses | None]:
    """Run all stages on a connected part; return the solved subgraph with poses, or the unsolvable part and None."""
    rotations, connected = average_rotations(state, part, options, initial)
    report_progress("uncertain pairs")
    connected = admit_confirmed_pairs(state, connected, rotations, options)
    report_progress("directions")
    fixed, centers = filter_directions(state, connected, rotations, options)
    if fixed.num_images < MIN_PART_IMAGES:
        return connected, None
    own = rotations[connected.rows_of(fixed.images)]
    poses = PartPoses(own, np.zeros((fixed.num_images, 3)), np.ones(num_cameras(state.graph)))
    if options.method != "epipolar":
        return fixed, place_by_method(state, fixed, poses, options)
    report_progress("tracks")
    problem = epipolar_problem(state.graph, fixed, options)
    if problem is None:
        fixed, poses = place_by_directions(state, fixed, poses, centers, options)
    else:
        report_progress("positions")
        poses = place_by_lengths(state, fixed, problem, poses, options)
        report_progress("epipolar adjustment")
        fixed, poses = adjust_poses(state, fixed, problem, poses, options)
    return (fixed, poses) if fixed.num_images >= MIN_PART_IMAGES else (connected, None)


def _initial_rotations(graph: ViewGraph, given: ArrayLike | None) -> Array:
    """Given rotations as an array, NaN if None."""
    shape = (graph.num_images, 3, 3)
    if given is None:
        return np.full(shape, np.nan)
    rotations = np.asarray(given, dtype=np.float64)
    if rotations.shape != shape:
        raise GraphError(f"solve_view_graph: initial_rotations have shape {rotations.shape}, expected {shape}")
    return rotations
