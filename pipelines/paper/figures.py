"""The numbers behind the paper's Fig. 2 to 5.

* Fig. 2 and 3: ``log10 lambda_ij / ||p_i - p_j||`` of CLS, whose scale factors stick to 1, against Alg. 1C's.
* Fig. 4: how often a method puts the inner cameras of the six-vertex graph outside the rhombus.
* Fig. 5: errors of measured rotations and directions, before and after 1DSfM.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.options import Method, SolveOptions
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.fixed_point import solve_fixed_point
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.six_vertices import inner_cameras_outside, six_vertex_scene
from colmap_vg.solver.solve import solve_view_graph
from paper.scenes import KnownScene

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ScaleFactors:
    """``log10 lambda_ij / ||p_i - p_j||`` of the edges that are left after 1DSfM.

    Attributes
    ----------
    cls, alg_1c : (e,) array
        An edge without length counts with its lambda over the smallest positive number.
    cls_share_at_one : float
        Edges whose scale factor CLS leaves at exactly 1.
    """

    cls: Array
    alg_1c: Array
    cls_share_at_one: float


@dataclass(frozen=True, eq=False)
class EdgeErrors:
    """Angles of measured to true relative poses, degrees.

    Attributes
    ----------
    rotation_deg, direction_deg : (m,) array
        NaN where the truth is unknown.
    kept : (m,) bool array
        Edges that 1DSfM and the rigid part leave.
    """

    rotation_deg: Array
    direction_deg: Array
    kept: BoolArray


def scale_factors(graph: ViewGraph, solution: PoseSolution) -> ScaleFactors:
    """Scale factors of CLS and Alg. 1C on the edges that a solution kept, at its rotations.

    1C's are those that go into one further turn of it, against the lengths that come out.

    Parameters
    ----------
    graph : ViewGraph
    solution : PoseSolution
        By a method that leaves the rotations as averaged, such as "cls".

    Raises
    ------
    GraphError
        The solution registers no image.
    """
    part = Subgraph.of(graph.edges, solution.registered, solution.edge_kept)
    if part.num_images == 0:
        raise GraphError("scale_factors: the solution registers no image")
    n, edges = part.num_images, part.edges
    R = solution.cam_from_world_rotations[part.images]
    directions = np.einsum("kba,kb->ka", R[edges[:, 0]], graph.cam2_in_cam1_directions[part.edge_rows])
    cls = solve_cls(n, edges, directions)
    fixed = solve_fixed_point(n, edges, directions, cls.projection_centers, "C")
    once_more = solve_fixed_point(
        n, edges, directions, fixed.projection_centers, "C", accelerate=False, max_num_iterations=1
    )
    return ScaleFactors(
        _log_ratio(cls.lambdas, _lengths(cls.projection_centers, edges)),
        _log_ratio(fixed.lambdas, once_more.lambdas),
        float(np.mean(cls.lambdas == 1.0)),
    )


def edge_errors(scene: KnownScene, solution: PoseSolution) -> EdgeErrors:
    """Errors of a scene's measured edges, and which a solution kept."""
    R, p, graph = scene.cam_from_world_rotations, scene.projection_centers, scene.graph
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    both = (scene.known[i] & scene.known[j])[:, None]
    safe = np.where(scene.known[:, None, None], R, np.eye(3))
    turn = np.einsum("kba,kbc->kac", graph.cam2_from_cam1_rotations, safe[j]) @ np.swapaxes(safe[i], 1, 2)
    true = np.einsum("kab,kb->ka", safe[i], np.where(both, p[j] - p[i], 0.0))
    rotation, direction = so3.angle(turn), angle_between(graph.cam2_in_cam1_directions, true)
    unknown = np.where(both[:, 0], 0.0, np.nan)
    return EdgeErrors(np.degrees(rotation) + unknown, np.degrees(direction) + unknown, solution.edge_kept)


def shares_outside(
    methods: Sequence[Method], num_draws: int = 500, error_deg: float = 5.0
) -> tuple[dict[str, float], dict[str, Array]]:
    """Fig. 4: share of draws in which an inner camera ends outside the rhombus.

    Parameters
    ----------
    methods : sequence of str
    num_draws : int
        Seeds 0, 1, ... of :func:`~colmap_vg.simulation.six_vertices.six_vertex_scene`.
    error_deg : float
        Of each direction, degrees.

    Returns
    -------
    shares : dict of method to float
    centers : dict of method to (6, 3) array
        Solved positions of the first draw that Cross (or else the first method) puts outside, or of the last draw.
    """
    outside: dict[str, list[bool]] = {method: [] for method in methods}
    witness = "cross" if "cross" in methods else methods[0]
    shown: dict[str, Array] = {}
    for seed in range(num_draws):
        scene = six_vertex_scene(error_deg, seed=seed)
        solved = {method: solve_view_graph(scene.graph, _six_vertex_options(method)) for method in methods}
        for method, solution in solved.items():
            outside[method].append(bool(inner_cameras_outside(solution.projection_centers).any()))
        if not shown and (outside[witness][-1] or seed == num_draws - 1):
            shown = {method: solution.projection_centers for method, solution in solved.items()}
    return {method: float(np.mean(found)) for method, found in outside.items()}, shown


SIX_VERTEX_TOLERANCE, SIX_VERTEX_ITERATIONS = 1e-5, 200
"""Which side of the rhombus a camera is on shows long before the last digits, which contradicting edges delay."""


def _six_vertex_options(method: Method) -> SolveOptions:
    return SolveOptions(
        method=method,
        rotation_averaging="chordal",
        rotation_gate_deg=0.0,
        outlier_filter="none",
        edge_weights="unit",
        convergence_tolerance=SIX_VERTEX_TOLERANCE,
        max_num_iterations=SIX_VERTEX_ITERATIONS,
    )


def _lengths(p: Array, edges: NDArray[np.int64]) -> Array:
    return np.asarray(np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1))


def _log_ratio(scale_factor: Array, length: Array) -> Array:
    tiny = np.finfo(float).tiny
    return np.asarray(np.log10(np.maximum(scale_factor, tiny)) - np.log10(np.maximum(length, tiny)))
