"""Algorithm 2 of Nasiri et al.: iterated pose-graph optimisation with scale factors from the previous positions.

Each outer iteration sets ``lambda_ij = ||p_j - p_i||`` and solves PS for translations ``lambda_ij gamma^l_ij`` with
rotation weight 1 and position weight ``w_ij = 1`` (**2C**, displacement error) or ``1 / ||p_j - p_i||^2`` (**2O**,
direction error). Then the centroid is set to 0, ``sum ||p||^2`` to its initial value, and the cameras' distances from
the centroid are limited, as in Alg. 1. In 2C that scale is the weight between the two terms; 2O does not depend on it.

With information matrices (**2W**, the weighted form) both terms are whitened, the displacement after division by the
length, and edges with large whitened residuals are down-weighted. Lengths and weights are fixed within an outer
iteration, as in 2O, which keeps a restoring force along the edge. Direct minimisation of the direction errors lacks it,
so that noise stretches weakly connected parts (eight to thirty times the error of 2O on simulated streets of 370 and
450 images).

The accuracy of the inner solves follows the current outer change, so that the fixed point is that of exact inner
solves. Anderson acceleration is applied to rotation vectors and positions jointly.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, cauchy_weight
from colmap_vg.pose_graph.costs import ChordalCost, InformationCost, PoseGraphCost
from colmap_vg.pose_graph.gauss_newton import PoseGraphSolver
from colmap_vg.positions.fixed_point import (
    MIN_RELATIVE_LENGTH,
    farthest_allowed,
    regauged,
    shortest_weighted_length,
)
from colmap_vg.positions.result import centered, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHORD_BELOW, CHORD_ACCURACY = 0.1, 0.03
"""Outer change below which inner problems are solved by the chord method, and accuracy as a share of the change."""
MEDIAN_OF_FIVE = 4.3515
"""Median of the chi-square distribution with five degrees of freedom, that of an edge's squared whitened residual."""


@dataclass(frozen=True, eq=False)
class JointResult:
    """Jointly solved rotations and positions, with convergence information.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        World frame, centroid 0, with the spread of the initial positions.
    cost : float
        Objective of PS at the last scale factors.
    num_iterations : int
        Number of outer iterations.
    converged : bool
    log : tuple of LogEntry
        One entry per outer iteration.
    """

    cam_from_world_rotations: Array
    projection_centers: Array
    cost: float
    num_iterations: int
    converged: bool
    log: tuple[LogEntry, ...]


def solve_joint(
    num_images: int,
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    cam2_in_cam1_directions: Array,
    initial_rotations: Array,
    initial_centers: Array,
    approach: Literal["C", "O"],
    weights: Array | None = None,
    *,
    rotation_weights: Array | None = None,
    information: Array | None = None,
    robust: bool = False,
    accelerate: bool = True,
    max_num_iterations: int = 1000,
    tolerance: float = 1e-10,
) -> JointResult:
    """Solve for rotations and positions by Alg. 2C or 2O from initial ones, usually those of RS and CLS.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_directions : (m, 3) array
        Unit ``gamma^l_ij``, camera 1's frame.
    initial_rotations : (n, 3, 3) array
        cam_from_world rotations.
    initial_centers : (n, 3) array
        Projection centres, world frame.
    approach : "C" or "O"
        Displacement or direction error.
    weights : (m,) array, optional
        Multipliers of both terms, default 1 (the paper).
    rotation_weights : (m,) array, optional
        Further multipliers of the rotation term only, default 1 (the paper).
    information : (m, 5, 5) array, optional
        Information matrix of each edge's rotation (vector in camera 2's frame) and direction (in its
        ``tangent_basis``), as in :class:`colmap_vg.two_view.edge_information.RefinedEdges`. It replaces the paper's
        equal weights (its open question); `weights` multiply it, `rotation_weights` its rotation block.
    robust : bool
        With `information`: multiply the information of each edge by the Cauchy weight of its whitened residual, at a
        scale that follows the median edge. Information that is correct up to a factor then suffices.
    accelerate : bool
        Whether to use Anderson acceleration.
    max_num_iterations : int
        Maximum number of outer iterations.
    tolerance : float
        Change of rotations (radians) and positions (relative) in one plain outer iteration below which the iteration
        ends.

    Returns
    -------
    JointResult

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    w = unit_weights(weights, len(edges))
    known = None if information is None else _spatial_information(information, cam2_in_cam1_directions)
    problem = _JointProblem(
        edges,
        cam2_from_cam1_rotations,
        cam2_in_cam1_directions,
        approach,
        w,
        w * unit_weights(rotation_weights, len(edges)),
        known,
        robust,
    )
    start = np.swapaxes(initial_rotations, 1, 2), centered(initial_centers)
    iteration = _OuterIteration(problem, PoseGraphSolver(num_images, edges), *start, accelerate)
    x, count, converged = fixed_point(
        iteration.step,
        iteration.pack(*start),
        accelerate=accelerate,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=iteration.note,
    )
    Q, p = iteration.unpack(x)
    return JointResult(np.swapaxes(Q, 1, 2), p, iteration.cost, count, converged, tuple(iteration.log))


@dataclass(frozen=True, eq=False)
class _JointProblem:
    """Relative poses with their weights; `information` (m, 6, 6) is that of rotation vectors and displacements."""

    edges: IntArray
    rotations: Array
    directions: Array
    approach: Literal["C", "O"]
    position_weights: Array
    rotation_weights: Array
    information: Array | None
    robust: bool

    def cost_at(self, Q: Array, p: Array, shortest: float, shortest_weighted: float) -> PoseGraphCost:
        """Cost of PS with scale factors and weights from the previous rotations and positions."""
        edges, w, kappa = self.edges, self.position_weights, self.rotation_weights
        length = np.maximum(np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1), shortest)
        tau = w if self.approach == "C" else w / np.maximum(length, shortest_weighted) ** 2
        translations = length[:, None] * self.directions
        if self.information is None:
            return ChordalCost(edges, self.rotations, translations, kappa, tau)
        root = np.sqrt(np.repeat(np.stack([kappa, tau], axis=1), 3, axis=1))
        weighted = root[:, :, None] * self.information * root[:, None, :]
        cost = InformationCost(edges, self.rotations, translations, weighted)
        if self.robust:
            cost = replace(cost, information=weighted * _cauchy_weights(cost, Q, p)[:, None, None])
        return cost


class _OuterIteration:
    """The outer iteration as a map of rotation vectors and positions (n, 6), and what it keeps from step to step.

    Rotation vectors are relative to the initial rotations, and positions in units of their initial root mean square.

    Attributes
    ----------
    cost : float
        Objective of PS in the last step.
    log : list of LogEntry
    """

    def __init__(
        self, problem: _JointProblem, solver: PoseGraphSolver, start_Q: Array, start_p: Array, accelerate: bool
    ) -> None:
        self._problem, self._solver, self._start_Q = problem, solver, start_Q
        self._size = spread(start_p)
        self._unit = self._size / np.sqrt(len(start_p))
        self._shortest = MIN_RELATIVE_LENGTH * self._unit
        self._shortest_weighted = shortest_weighted_length(start_p, problem.edges)
        self._reach = farthest_allowed(start_p)
        # The plain form solves every inner problem accurately, as in the paper; the accelerated one as the change
        # requires.
        self._inner_tolerance, self._tolerance_per_change = (1e-3, 1e-2) if accelerate else (1e-6, 1e-3)
        self._accelerate, self._change = accelerate, np.inf
        self.cost = np.inf
        self.log: list[LogEntry] = []

    def pack(self, Q: Array, p: Array) -> Array:
        """Rotation vectors and positions (n, 6) of world_from_cam rotations Q and positions p."""
        return np.concatenate([so3.log(Q @ np.swapaxes(self._start_Q, 1, 2)), p / self._unit], axis=1)

    def unpack(self, x: Array) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3), the inverse of :meth:`pack`."""
        return so3.exp(x[:, :3]) @ self._start_Q, x[:, 3:] * self._unit

    def step(self, x: Array) -> Array:
        """Solve PS with scale factors from x, and restore the gauge."""
        Q, p = self.unpack(x)
        cost = self._problem.cost_at(Q, p, self._shortest, self._shortest_weighted)
        # The inner minimum is p, scaled: start there to save steps.
        p = p * cost.best_scale(Q, p)
        if self._accelerate and self._change < CHORD_BELOW:
            solved = self._solver.solve_nearby(cost, Q, p, self._unit, CHORD_ACCURACY * self._change)
            if solved is not None:
                self.cost = cost.value(*solved)
                return self._restored(*solved)
        Q, p, inner = self._solver.solve(cost, Q, p, tolerance=self._inner_tolerance)
        self.cost = inner.cost
        return self._restored(Q, p)

    def _restored(self, Q: Array, p: Array) -> Array:
        # The global rotation is free: fix the first camera, so that the fixed point is unique.
        turn = self._start_Q[0] @ Q[0].T
        return self.pack(turn @ Q, regauged(centered(p @ turn.T), self._size, self._reach))

    def note(self, iteration: int, _: Array, change: float) -> None:
        """Log an iteration, and adapt the accuracy of the inner solves to its change."""
        self._change = change
        self._inner_tolerance = min(self._inner_tolerance, max(self._tolerance_per_change * change, 1e-13))
        name = "2W" if self._problem.robust else "2" + self._problem.approach
        self.log.append(LogEntry(name, iteration, self.cost, change))


def _cauchy_weights(cost: InformationCost, Q: Array, p: Array) -> Array:
    """Cauchy weights (m,) of the edges' whitened residuals, at a scale from the median edge."""
    e = cost.residuals(Q, p)
    squared = np.einsum("ka,kab,kb->k", e, cost.information, e, optimize=True)
    variance = max(float(np.median(squared)) / MEDIAN_OF_FIVE, np.finfo(np.float64).tiny)
    return cauchy_weight(squared / (EFFICIENT_CAUCHY**2 * variance))


def _spatial_information(information: Array, directions: Array) -> Array:
    """Information matrices (m, 6, 6) of rotation vectors and displacements over their lengths.

    A direction has no information on its length, but without a term along it the scale factors would not keep the
    positions apart. The mean of the two tangential entries is used, so that isotropic information gives the paper's
    cost.
    """
    lift = np.zeros((len(directions), 6, 5))
    lift[:, :3, :3] = np.eye(3)
    lift[:, 3:, 3:] = tangent_basis(directions)
    spatial = lift @ information @ np.swapaxes(lift, 1, 2)
    along = 0.5 * (information[:, 3, 3] + information[:, 4, 4])
    spatial[:, 3:, 3:] += along[:, None, None] * directions[:, :, None] * directions[:, None, :]
    return np.asarray(spatial)
