"""Primal-dual Newton steps for positions of least unsquared distances, ``min sum w ||r(p_j - p_i)||``.

The residual r of an edge is the difference ``d = p_j - p_i`` to the nearest point of a convex set, so that the problem
is convex. With dual vectors v, ``||v|| <= 1``, a minimum satisfies ``||r|| v = r`` and ``B^T w v = 0`` (B is the
incidence matrix). Norms are smoothed, ``s = sqrt(||r||^2 + e^2)``, and Newton's method solves ``s v = r`` in positions
and dual vectors jointly (Chan, Golub & Mulet, SISC 1999), which converges fast while e decreases with the duality gap,
where Newton's method in positions alone, or reweighting, slows down.
"""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize
from colmap_vg.positions.result import centered
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-12
"""Share of each camera's stiffness added to it: it fixes translations, and the scale if residuals vanish."""
SMOOTHING_SHARE = 0.1
"""Smoothing e of the next step: this share of the duality gap, divided by the weight of edges with zero residual."""
MAX_DECREASE, DECREASE = 0.1, 0.4
"""Smallest ratio of the smoothing to that of the previous step, and largest after a whole step: the smoothed problem is
nearly solved then, and its gap may belong to more edges than those of zero residual."""
PATIENCE = 10
"""Number of steps without a smaller gap after which the iteration ends."""
MIN_STEP = 2.0**-10
"""Smallest step length of the line search."""
ROUNDING = 1e-13
"""Costs below this share of the sum of weighted lengths are zero: the directions are consistent."""


class UnsquaredDistances(ABC):
    """Objective, Newton steps on its smoothed form, and dual bound; subclasses say which sets the distances are to.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    directions : (m, 3) array
        Unit ``gamma_ij``, world frame.
    w : (m,) array
        Multipliers of the distances.
    """

    def __init__(self, num_images: int, edges: IntArray, directions: Array, w: Array) -> None:
        self.num_images, self.i, self.j = num_images, edges[:, 0], edges[:, 1]
        self.gamma, self.w = directions, w
        self.across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        self._pattern = BlockPattern(num_images, edges, 3)
        # At most as many edges as unknowns have zero residual; only these are affected by the smoothing.
        self._weight_of_kinks = float(w.mean()) * min(len(w), 3 * num_images)

    @abstractmethod
    def residual(self, p: Array) -> Array:
        """Residuals r (m, 3)."""

    @abstractmethod
    def derivative(self, p: Array) -> Array:
        """Symmetric derivatives (m, 3, 3) of the residuals by ``p_j - p_i``."""

    @abstractmethod
    def gap(self, p: Array, v: Array) -> float:
        """Cost minus a lower bound from dual vectors v (m, 3)."""

    @abstractmethod
    def step(self, H: Array, gradient: Array) -> Array:
        """Newton step (n, 3) for Hessian blocks H (m, 3, 3) of the edges and the gradient (n, 3)."""

    @abstractmethod
    def restored(self, p: Array) -> Array:
        """Positions in the gauge of the problem."""

    def cost(self, p: Array) -> float:
        """The objective, not smoothed."""
        return float(np.sum(self.w * np.linalg.norm(self.residual(p), axis=1)))

    def along(self, p: Array) -> Array:
        """Lengths (m,) along the directions, ``gamma . (p_j - p_i)``."""
        return np.asarray(np.einsum("ka,ka->k", self.gamma, p[self.j] - p[self.i]))

    def vanishes(self, p: Array) -> bool:
        """Whether the cost is zero up to rounding."""
        lengths = np.linalg.norm(p[self.j] - p[self.i], axis=1)
        return self.cost(p) <= ROUNDING * float(np.sum(self.w * lengths))

    def at_nodes(self, flow: Array) -> Array:
        """``B^T flow``: sums (n, 3) at the second cameras of edges minus those at the first."""
        return sum_at_nodes(self.num_images, self.j, flow) - sum_at_nodes(self.num_images, self.i, flow)

    def factor(self, H: Array) -> Factor:
        """Factor the matrix of blocks H (m, 3, 3) of the edges, damped as far as it takes."""
        trace = np.trace(H, axis1=1, axis2=2) / 3.0
        stiffness = np.bincount(self.i, trace, self.num_images) + np.bincount(self.j, trace, self.num_images)
        level = DAMPING * stiffness[:, None, None] * np.eye(3)
        while True:
            try:
                return factorize(self._pattern.assemble(H, H, -H, level))
            except SingularMatrixError:  # weights differ by many orders of magnitude: the damping is lost to rounding
                level = 10.0 * level

    @staticmethod
    def solve(factor: Factor, b: Array) -> Array:
        """Centred solution (n, 3)."""
        return centered(factor.solve(b.ravel()).reshape(-1, 3))

    def minimize(
        self, p: Array, stage: str, max_num_iterations: int, tolerance: float
    ) -> tuple[Array, bool, tuple[LogEntry, ...]]:
        """Minimise from given positions.

        Parameters
        ----------
        p : (n, 3) array
        stage : str
            Name in the log.
        max_num_iterations : int
            Maximum number of Newton steps.
        tolerance : float
            Duality gap at convergence, relative to the cost.

        Returns
        -------
        p : (n, 3) array
            Positions of least cost on the way.
        converged : bool
        log : tuple of LogEntry
            `change` is the relative duality gap.
        """
        v, smoothing = np.zeros_like(self.gamma), float(np.linalg.norm(self.residual(p), axis=1).mean())
        log, most = list[LogEntry](), 1.0
        best, best_cost, best_gap, best_iteration = p, np.inf, np.inf, 0
        for iteration in range(max_num_iterations):
            cost, gap = self.cost(p), 0.0 if self.vanishes(p) else self.gap(p, v)
            log.append(LogEntry(stage, iteration, cost, gap / max(cost, np.finfo(float).tiny)))
            if cost < best_cost:
                best, best_cost = p, cost
            if gap < best_gap:
                best_gap, best_iteration = gap, iteration
            # A gap that no longer decreases has reached rounding.
            if best_gap <= tolerance * best_cost or iteration >= best_iteration + PATIENCE:
                break
            wanted = SMOOTHING_SHARE * gap / self._weight_of_kinks
            smoothing = float(np.clip(wanted, MAX_DECREASE * smoothing, most * smoothing))
            p, v, share = self._improved(p, v, smoothing)
            most = DECREASE if share == 1.0 else 1.0
        return best, best_gap <= tolerance * best_cost, tuple(log)

    def _improved(self, p: Array, v: Array, smoothing: float) -> tuple[Array, Array, float]:
        """Take a Newton step on ``s v = r`` in positions and multipliers; the last value is the share of it taken."""
        r, across = self.residual(p), self.derivative(p)
        v = np.einsum("kab,kb->ka", across, v)
        s = np.hypot(np.linalg.norm(r, axis=1), smoothing)[:, None]
        gradient = self.at_nodes(self.w[:, None] * r / s)
        mixed = v[:, :, None] * (r / s)[:, None, :]
        H = (self.w[:, None] / s)[:, :, None] * (across - 0.5 * (mixed + np.swapaxes(mixed, 1, 2)))
        step = self.step(H, gradient)
        moved = np.einsum("kab,kb->ka", across, step[self.j] - step[self.i])
        turned = (r + moved - 0.5 * (v * _dot(r, moved) + r * _dot(v, moved)) / s) / s
        # Rounding errors along gamma, divided by s, would invalidate the bound.
        turned = np.einsum("kab,kb->ka", across, turned)
        slope, start = float(np.vdot(step, gradient)), self._smooth_cost(p, smoothing)
        length = 1.0
        while length > MIN_STEP and self._smooth_cost(p + length * step, smoothing) > start + 1e-4 * length * slope:
            length *= 0.5
        share = _share_inside(v, turned - v)
        return self.restored(p + length * step), v + share * (turned - v), min(length, share)

    def _smooth_cost(self, p: Array, smoothing: float) -> float:
        return float(np.sum(self.w * np.hypot(np.linalg.norm(self.residual(p), axis=1), smoothing)))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ka,ka->k", a, b)[:, None])


def _share_inside(v: Array, step: Array) -> float:
    """Largest share of the step, at most 1, that keeps every ``||v|| <= 1``."""
    a, b = np.einsum("ka,ka->k", step, step), np.einsum("ka,ka->k", v, step)
    c = np.minimum(np.einsum("ka,ka->k", v, v) - 1.0, 0.0)
    root = np.sqrt(b * b - a * c)
    # The positive root of a t^2 + 2 b t + c = 0, in the form without cancellation.
    far = np.where(b > 0, -c, root - b)
    below = np.where(b > 0, b + root, a)
    share = float(np.min(np.where(far >= below, 1.0, far / np.where(below > 0, below, 1.0)), initial=1.0))
    return share if share == 1.0 else 0.99 * share  # on the sphere itself the next step would have length zero
