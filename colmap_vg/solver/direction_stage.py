"""Stage 2 of the solver: the part whose positions are determined, after removing outlier directions."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.baseline_lengths import estimate_baseline_ratios
from colmap_vg.epipolar.problem import epipolar_problem
from colmap_vg.linear.robust_losses import geman_mcclure_weight
from colmap_vg.options import SolveOptions
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.direction_filter import robust_direction_residuals
from colmap_vg.solver.edge_weights import edge_weights
from colmap_vg.solver.one_dsfm import one_dsfm_broken_weights
from colmap_vg.solver.part_poses import world_directions
from colmap_vg.solver.state import SolverState

Array = NDArray[np.float64]

TRUST_PER_MEDIAN, TRUST_SCALES_DEG = 20.0, (3.0, 10.0)
"""Geman-McClure scale for weights of directions by rotation residuals, over the median residual, and its range in
degrees. Without these weights a false pair across a long street would fold it, since its displacement error is
larger."""


def filter_directions(
    state: SolverState, part: Subgraph, rotations: Array, options: SolveOptions
) -> tuple[Subgraph, Array | None]:
    """Drop edges whose directions are outliers.

    Returns
    -------
    fixed : Subgraph
        The largest part whose positions are determined.
    centers : (k, 3) array or None
        Positions of its images that the robust filter fitted to the directions.
    """
    rigid = fixed_part(state, part, options)
    if rigid.num_images < 3 or options.outlier_filter == "none":
        return rigid, None
    centers = None
    own = rotations[part.rows_of(rigid.images)]
    directions = world_directions(state.graph, rigid, own)
    if options.outlier_filter == "1dsfm":
        broken = one_dsfm_broken_weights(
            rigid.num_images, rigid.edges, directions, options.one_dsfm_num_directions, options.random_seed
        )
        state.drop(rigid.edge_rows[broken > options.one_dsfm_threshold], EdgeVerdict.ONE_DSFM)
    elif options.direction_gate_deg > 0:
        weights = edge_weights(state.graph, rigid.edge_rows, options) * _rotation_trust(state.graph, rigid, own)
        centers, angles = robust_direction_residuals(rigid.num_images, rigid.edges, directions, weights)
        state.drop(rigid.edge_rows[angles > np.radians(options.direction_gate_deg)], EdgeVerdict.DIRECTION_OUTLIER)
    fixed = fixed_part(state, rigid, options)
    return fixed, None if centers is None else centers[rigid.rows_of(fixed.images)]


def fixed_part(state: SolverState, part: Subgraph, options: SolveOptions) -> Subgraph:
    """Largest part whose positions directions determine, or directions and three-view tracks if that is not all."""
    fixed = state.largest_rigid_part(part, options.random_seed)
    if fixed.num_images == part.num_images or options.method != "epipolar":
        return fixed
    graph = state.graph
    kept = part.with_edges(state.usable[part.edge_rows])
    problem = epipolar_problem(graph, kept, options)
    if problem is None:
        return fixed
    rows = kept.edge_rows
    ratios = estimate_baseline_ratios(
        problem, graph.cam2_from_cam1_rotations[rows], graph.cam2_in_cam1_directions[rows]
    )
    state.note_ratios(rows[ratios.edges[ratios.reliable]])
    return state.largest_rigid_part(part, options.random_seed)


def _rotation_trust(graph: ViewGraph, part: Subgraph, rotations: Array) -> Array:
    """Weights (e,) of directions by the rotation residuals of their edges, since false pairs are wrong in both."""
    residuals = rotation_residuals(part.edges, graph.cam2_from_cam1_rotations[part.edge_rows], rotations)
    scale = np.clip(TRUST_PER_MEDIAN * np.median(residuals), *np.radians(TRUST_SCALES_DEG))
    return geman_mcclure_weight((residuals / scale) ** 2)
