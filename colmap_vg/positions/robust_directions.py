"""Positions that minimise a robust direction error, with the standard deviation of each position.

The residual is that of Alg. 1O (eq. CLE1 of Nasiri et al.), ``r = gamma - b / ||b||`` with ``b = p_j - p_i``, under a
Cauchy loss whose scale follows the residuals. Edges shorter than a small share of the initial median length are divided
by that length instead of their own: otherwise inconsistent edges would be explained by collapsing cameras, or by moving
one camera away so that the gauge collapses the others. Levenberg-Marquardt minimises the cost twice, the second time
with weights from the noise estimated per edge length, since directions over longer baselines are more accurate.

Iterating LS2 instead takes hundreds of iterations if groups of cameras are weakly connected (on 336 simulated cameras,
80 % were within 5 % of the truth after sixty iterations, 99 % at the minimum).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, cauchy_loss, cauchy_weight
from colmap_vg.linear.solvers import Factor, factorize
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_LENGTH = 1e-2
"""Lower limit of edge lengths in the residuals, as a share of the initial median edge length."""
MIN_SCALE = 1e-6
"""Lower limit of the scale of the loss, radians; below the noise of any relative pose, and finite for exact data."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a vector of two independent standard normal deviates, such as a direction's error in its tangent
plane."""
INITIAL_DAMPING, MAX_DAMPING = 1.0, 1e8
"""Initial and largest damping, as shares of each camera's mean curvature. A large initial value keeps the iteration in
the basin of the initial positions."""
ROUGH_TOLERANCE = 1e-4
"""Tolerance of the first minimisation, from which only the noise is estimated."""
NUM_SAMPLES = 64
"""Number of noise samples from which standard deviations are estimated, to within 9 %."""
EDGES_PER_BIN, MAX_NUM_BINS = 50, 12
"""Edges per bin of similar length whose noise is estimated together (the median of fifty is within a tenth of its
value), and largest number of bins."""


@dataclass(frozen=True, eq=False)
class RobustDirections:
    """Positions with the weights and the noise of the directions.

    Attributes
    ----------
    positions : PositionResult
        `lambdas` are edge lengths, `cost` is the Cauchy cost at the last scale.
    weights : (m,) array
        Weights of the edges at the minimum: squared-residual weights times those of the loss.
    sigmas : (m,) array
        Standard deviation of each direction in each axis of its tangent plane, radians.
    """

    positions: PositionResult
    weights: Array
    sigmas: Array


def solve_robust_directions(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    initial_centers: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 100,
    tolerance: float = 1e-6,
) -> RobustDirections:
    """Minimise the robust direction error from given positions.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    initial_centers : (n, 3) array
        Initial positions close to the solution, such as those of Alg. 1C; their spread is kept.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1.
    max_num_iterations : int
        Maximum number of accepted steps.
    tolerance : float
        Relative change of the cost below which the iteration ends.

    Returns
    -------
    RobustDirections

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    given = unit_weights(weights, len(edges))
    p, log = centered(initial_centers), list[LogEntry]()
    problem = _Problem(num_images, edges, directions_world, given, p)
    again = len(edges) >= 2 * EDGES_PER_BIN
    rough = max(tolerance, ROUGH_TOLERANCE) if again else tolerance
    at, scale, converged = _minimized(problem, p, log, max_num_iterations, rough)
    sigmas = _noise_by_length(at, given, num_images)
    weights_by_length = (np.median(sigmas * np.sqrt(given)) / sigmas) ** 2
    if again:
        problem = _Problem(num_images, edges, directions_world, weights_by_length, p)
        at, scale, converged = _minimized(problem, at.p, log, max_num_iterations, tolerance)
        sigmas = _noise_by_length(at, given, num_images)
    lengths = np.linalg.norm(at.p[edges[:, 1]] - at.p[edges[:, 0]], axis=1)
    result = PositionResult(at.p, lengths, problem.cost(at, scale), len(log), converged, tuple(log))
    return RobustDirections(result, problem.robust_weights(at, scale), sigmas)


def _minimized(
    problem: "_Problem", p: Array, log: list[LogEntry], max_num_iterations: int, tolerance: float
) -> tuple["_Point", float, bool]:
    """Minimise from given positions; return the minimum, the scale of the loss, and whether the cost converged."""
    at, scale, damping = problem.at(p), np.inf, INITIAL_DAMPING
    for iteration in range(1, max_num_iterations + 1):
        # The scale only decreases, so that the cost decreases from step to step.
        scale = min(scale, max(EFFICIENT_CAUCHY * problem.sigma(at), MIN_SCALE))
        cost = problem.cost(at, scale)
        found = problem.step(at, scale, cost, damping)
        if found is None:
            return at, scale, True
        # After a rejected step the damping stays: the next step of a tenth would be rejected, too.
        damping = found[2] / 10.0 if found[2] == damping else found[2]
        at, new_cost = found[0], found[1]
        change = (cost - new_cost) / cost
        log.append(LogEntry("directions", iteration, new_cost, change))
        if change < tolerance:
            return at, scale, True
    return at, scale, False


def _noise_by_length(at: "_Point", weights: Array, num_images: int) -> Array:
    """Standard deviations (m,) of directions, radians, from the weighted residuals of edges of similar length."""
    # Two equations per edge, three unknowns per camera, minus translation and scale.
    num_equations = 2 * len(weights)
    freedom = np.sqrt(num_equations / max(num_equations - (3 * num_images - 4), 1))
    whitened = np.linalg.norm(at.r, axis=1) * np.sqrt(weights)
    bins = np.array_split(
        np.argsort(at.length, kind="stable"), np.clip(len(whitened) // EDGES_PER_BIN, 1, MAX_NUM_BINS)
    )
    lengths = [float(np.median(at.length[rows])) for rows in bins]
    noise = [max(float(np.median(whitened[rows])) / RAYLEIGH_MEDIAN, MIN_SCALE / EFFICIENT_CAUCHY) for rows in bins]
    return np.asarray(np.exp(np.interp(np.log(at.length), np.log(lengths), np.log(noise))) * freedom / np.sqrt(weights))


def position_deviations(
    num_images: int,
    edges: IntArray,
    solved: RobustDirections,
    seed: int = 0,
    *,
    num_samples: int = NUM_SAMPLES,
) -> Array:
    """Standard deviation of each position under the noise of the directions, to first order.

    Noise samples are propagated through the normal equations at the minimum, one solve each. Translation and scale are
    removed by medians, so that a poorly determined camera does not affect the deviations of the others.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    solved : RobustDirections
    seed : int
        Random seed of the noise samples.
    num_samples : int
        Number of noise samples.

    Returns
    -------
    (n,) array
        Square root of the trace of each position's covariance, in the unit of the positions.
    """
    p, w = solved.positions.projection_centers, solved.weights
    problem = _Problem(num_images, edges, np.zeros((len(edges), 3)), w, p)
    at, middle = problem.at(p), p - np.median(p, axis=0)
    distance_squared = np.maximum(np.sum(middle**2, axis=1), np.finfo(float).tiny)
    factor = problem.factor(problem.blocks(at, w), 0.0)
    rng = np.random.default_rng(seed)
    squares = np.zeros(num_images)
    for _ in range(num_samples):
        noise = solved.sigmas[:, None] * rng.standard_normal((len(edges), 3))
        pull = (w / at.length)[:, None] * np.einsum("kab,kb->ka", at.tangent, noise)
        moved = factor.solve(problem.at_images(pull).ravel()).reshape(num_images, 3)
        moved -= np.median(moved, axis=0)
        moved -= np.median(np.sum(moved * middle, axis=1) / distance_squared) * middle
        squares += np.sum(moved**2, axis=1)
    return np.asarray(np.sqrt(squares / num_samples))


@dataclass(frozen=True, eq=False)
class _Point:
    """Positions (n, 3), residuals (m, 3), bounded edge lengths (m,), and ``-length dr/db`` (m, 3, 3)."""

    p: Array
    r: Array
    length: Array
    tangent: Array


class _Problem:
    def __init__(self, num_images: int, edges: IntArray, directions: Array, weights: Array, start: Array) -> None:
        self._n, self._i, self._j = num_images, edges[:, 0], edges[:, 1]
        self._gamma, self._w, self._spread = directions, weights, spread(start)
        self._shortest = MIN_LENGTH * float(np.median(np.linalg.norm(start[self._j] - start[self._i], axis=1)))
        self._pattern = BlockPattern(num_images, edges, 3)

    def at(self, p: Array) -> _Point:
        b = p[self._j] - p[self._i]
        own = np.linalg.norm(b, axis=1)
        short = own < self._shortest
        length = np.where(short, self._shortest, own)
        u = b / length[:, None]
        along = np.where(short[:, None], 0.0, u)
        return _Point(p, self._gamma - u, length, np.eye(3) - along[:, :, None] * along[:, None, :])

    def cost(self, at: _Point, scale: float) -> float:
        return float(np.sum(cauchy_loss(self._w * np.sum(at.r**2, axis=1) / scale**2)) * scale**2)

    def robust_weights(self, at: _Point, scale: float) -> Array:
        return self._w * cauchy_weight(self._w * np.sum(at.r**2, axis=1) / scale**2)

    def sigma(self, at: _Point) -> float:
        """Robust standard deviation of the weighted residuals per axis of their tangent planes."""
        return float(np.median(np.linalg.norm(at.r, axis=1) * np.sqrt(self._w))) / RAYLEIGH_MEDIAN

    def blocks(self, at: _Point, weights: Array) -> Array:
        return np.asarray((weights / at.length**2)[:, None, None] * at.tangent)

    def at_images(self, pull: Array) -> Array:
        return sum_at_nodes(self._n, self._j, pull) - sum_at_nodes(self._n, self._i, pull)

    def factor(self, blocks: Array, damping: float) -> Factor:
        on_diagonal = sum_at_nodes(self._n, self._i, blocks) + sum_at_nodes(self._n, self._j, blocks)
        curvature = np.trace(on_diagonal, axis1=1, axis2=2) / 3.0
        # Translation and scale are free: damping far below the rounding of the result makes the matrix definite.
        added = damping * curvature + 1e-10 * curvature.mean()
        return factorize(self._pattern.assemble(blocks, blocks, -blocks, added[:, None, None] * np.eye(3)))

    def step(self, at: _Point, scale: float, cost: float, damping: float) -> tuple[_Point, float, float] | None:
        """The next point, its cost and the damping used; None if no step lowers the cost."""
        w = self.robust_weights(at, scale)
        blocks = self.blocks(at, w)
        pull = self.at_images((w / at.length)[:, None] * np.einsum("kab,kb->ka", at.tangent, at.r)).ravel()
        while damping <= MAX_DAMPING:
            new = centered(at.p + self.factor(blocks, damping).solve(pull).reshape(self._n, 3))
            point = self.at(new * (self._spread / spread(new)))
            new_cost = self.cost(point, scale)
            if new_cost < cost:
                return point, new_cost, damping
            damping *= 10.0
        return None
