"""Robust rotation averaging by iteratively reweighted least squares: spanning tree, L1, then Geman-McClure.

Chatterjee & Govindu, "Robust Relative Rotation Averaging" (PAMI 2018). With updates in the world frame,
``R_i <- R_i exp(x_i)``, the residual ``r_ij = log(R_j^T R_ij R_i)`` of an edge changes by ``-(x_j - x_i)``, with the
same coefficients for all three axes. Each reweighted step therefore solves one scalar graph Laplacian with three
right-hand sides.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.events import report_progress
from colmap_vg.geometry import quaternions
from colmap_vg.linear.laplacian import ReweightedLaplacian
from colmap_vg.linear.robust_losses import geman_mcclure_weight
from colmap_vg.rotations.problem import RotationResult, checked_initial, checked_problem
from colmap_vg.rotations.spanning_tree import rotations_from_spanning_tree
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]

L1_FLOOR = np.radians(0.5)
"""Lower limit of residuals in the L1 weights 1/r, radians: the noise level of good edges."""
SIGMA_PER_QUARTILE = 2.3
"""Final Geman-McClure scale over the lower quartile of the residuals, dimensionless. For isotropic normal noise the
quartile is 1.1 standard deviations of an axis, so the scale is 2.5 of them. A quartile, because up to half of real
edges are outliers."""
MIN_SIGMA = np.radians(0.1)
"""Lower limit of the scale in the last phase, radians; it would vanish on noise-free graphs."""
L1_TOLERANCE = 3e-3
"""Step at which the L1 phase ends, radians. With an earlier stop the result depends on the spanning tree."""
FIRST_TOLERANCE = 1e-3
"""Step at which the scale is adapted, radians; COLMAP's last tolerance."""


def average_rotations_robust(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    weights: ArrayLike | None = None,
    initial: ArrayLike | None = None,
    *,
    sigma_deg: float = 5.0,
    adapt_sigma: bool = True,
    max_num_l1_iterations: int = 30,
    max_num_iterations: int = 100,
    tolerance: float = 1e-4,
) -> RotationResult:
    """Average rotations by minimising ``sum w_ij rho(r_ij)``, ``rho(r) = r^2 / (1 + r^2 / sigma^2)`` (Geman-McClure).

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
        ``R_ij = R_j R_i^T`` for cam_from_world rotations R.
    weights : (m,) array, optional
        Multipliers of the loss, and edge weights of the spanning tree. Default: all one.
    initial : (n, 3, 3) array, optional
        Initial cam_from_world rotations. Default: those of the maximum spanning tree.
    sigma_deg : float
        Scale of the Geman-McClure loss, degrees; COLMAP's default.
    adapt_sigma : bool
        Whether to end with a smaller scale, 2.3 times the lower quartile of the residuals, if it is below `sigma_deg`.
    max_num_l1_iterations, max_num_iterations : int
        Maximum number of iterations of the L1 phase and of each Geman-McClure phase. The L1 phase corrects the drift of
        long chains after a poor initialisation, but moves away from a good one if half of the edges are false: 0 skips
        it.
    tolerance : float
        Root mean square step of the images at which a Geman-McClure phase ends, radians.

    Returns
    -------
    RotationResult
        `cost` is the Geman-McClure objective at the final scale, radians squared.

    Raises
    ------
    GraphError
        The graph is malformed or disconnected.
    """
    return RobustAveraging(num_images, edges, cam2_from_cam1_rotations, weights).run(
        initial,
        sigma_deg=sigma_deg,
        adapt_sigma=adapt_sigma,
        max_num_l1_iterations=max_num_l1_iterations,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
    )


class RobustAveraging:
    """Averaging as :func:`average_rotations_robust`, on a graph that is prepared once for several starts.

    Parameters
    ----------
    num_images, edges, cam2_from_cam1_rotations, weights
        As those of :func:`average_rotations_robust`.
    """

    def __init__(
        self,
        num_images: int,
        edges: ArrayLike,
        cam2_from_cam1_rotations: ArrayLike,
        weights: ArrayLike | None = None,
    ) -> None:
        self.num_images = num_images
        self.edges, self._matrices, self.weights = checked_problem(num_images, edges, cam2_from_cam1_rotations, weights)
        self.relative = quaternions.from_matrices(self._matrices)
        self.laplacian = ReweightedLaplacian(num_images, self.edges)

    def run(
        self,
        initial: ArrayLike | None = None,
        *,
        sigma_deg: float,
        adapt_sigma: bool,
        max_num_l1_iterations: int,
        max_num_iterations: int,
        tolerance: float,
    ) -> RotationResult:
        """Average from one start, with the options of :func:`average_rotations_robust`."""
        start = checked_initial(self.num_images, initial)
        if start is None:
            start = rotations_from_spanning_tree(self.num_images, self.edges, self._matrices, self.weights)
        if self.num_images == 1:
            return RotationResult(start, 0.0, 0, True, ())
        self.laplacian.forget()
        loop = _Reweighting(self, start)
        if max_num_l1_iterations:
            loop.run(_l1, max_num_l1_iterations, L1_TOLERANCE)
        loss = _geman_mcclure(np.radians(sigma_deg))
        converged = loop.run(loss, max_num_iterations, max(tolerance, FIRST_TOLERANCE) if adapt_sigma else tolerance)
        if adapt_sigma:
            sigma = max(MIN_SIGMA, SIGMA_PER_QUARTILE * float(np.quantile(loop.angles, 0.25)))
            loss = _geman_mcclure(min(sigma, np.radians(sigma_deg)))
            converged = loop.run(loss, max_num_iterations, tolerance)
        cost = loop.step(loss, relative_tolerance=1e-8)
        return RotationResult(quaternions.to_matrices(loop.absolute), cost, len(loop.log), converged, tuple(loop.log))


Loss = Callable[[Array], tuple[Array, Array]]
"""Function of residuals (m,) in radians that returns weights (m,) and losses (m,)."""


def _l1(r: Array) -> tuple[Array, Array]:
    return 1.0 / np.maximum(r, L1_FLOOR), r


def _geman_mcclure(sigma: float) -> Loss:
    def loss(r: Array) -> tuple[Array, Array]:
        s = np.square(r / sigma)
        return geman_mcclure_weight(s), sigma**2 * s / (1.0 + s)

    return loss


class _Reweighting:
    """State of the iteratively reweighted least squares on absolute rotations."""

    def __init__(self, problem: RobustAveraging, start: Array) -> None:
        self.log: list[LogEntry] = []
        self.absolute = quaternions.from_matrices(start)
        self._i, self._j = problem.edges[:, 0], problem.edges[:, 1]
        self._relative, self._weights, self._laplacian = problem.relative, problem.weights, problem.laplacian
        self._residuals, self.angles = self._measure()

    def run(self, loss: Loss, max_num_iterations: int, tolerance: float) -> bool:
        """Iterate until the root mean square step is below the tolerance; return whether it was reached."""
        for _ in range(max_num_iterations):
            report_progress("rotations")
            self.step(loss, relative_tolerance=1e-2)
            if self.log[-1].change <= tolerance:
                return True
        return False

    def step(self, loss: Loss, relative_tolerance: float) -> float:
        """Take one reweighted least-squares step, solved to a relative accuracy; return the cost after it."""
        w = self._weights * loss(self.angles)[0]
        x = self._laplacian.solve(w, self._laplacian.divergence(w * self._residuals), relative_tolerance)
        self.absolute = quaternions.multiply(self.absolute, quaternions.exp(x.T))
        self._residuals, self.angles = self._measure()
        cost = float(self._weights @ loss(self.angles)[1])
        self.log.append(LogEntry("rotations", len(self.log) + 1, cost, float(np.sqrt(np.mean(x * x) * 3.0))))
        return cost

    def _measure(self) -> tuple[Array, Array]:
        """Residuals ``log(R_j^T R_ij R_i)`` as vectors (3, m) and angles (m,), radians."""
        q = self.absolute
        at_second = quaternions.multiply(quaternions.conjugate(q)[:, self._j], self._relative)
        return quaternions.log(quaternions.multiply(at_second, q[:, self._i]))
