"""Weighted residuals of all observations and their derivatives, with a Cauchy loss.

A residual is the projection of a point minus its keypoint, pixels. Lenses are any projections of rays: derivatives by
the ray and by a lens's parameters are central differences, exact to about ten digits. Derivatives by poses follow from
those by points: with the world's ray ``d = X - c``, a rotation ``R exp(w)`` and ``A = dr / dX``, they are
``dr / dw = -A x d`` row by row, and ``dr / dc = -A``.

Arrays have the observations last, so that each operation runs along memory.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.bundle.problem import BundleProblem, BundleState, Lens
from colmap_vg.linear.robust_losses import cauchy_loss, cauchy_weight

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

DIFFERENCE = 1e-6
"""Half the interval of central differences, of unit rays and relative to lens parameters above one."""
LOST_PX = 1000.0
"""Residual of an observation without a projection, pixels: no step gains by losing points."""
MAX_RELAXATION = 1.9
"""Maximum factor of a step; twice the step to the minimum of a quadratic bound of the cost would gain nothing."""


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals and derivatives at one state, multiplied by the roots of the loss's weights.

    Attributes
    ----------
    rays : (3, k) array
        Point minus projection centre, world frame.
    residuals : (2, k) array
    by_point : (2, 3, k) array
    by_lens : (2, t, k) array
        By the unknown parameters of the image's lens, padded with zeros.
    costs : (q,) array
        Cost of each point, pixels squared.
    relaxation : float
        Factor of steps. Weights bound the cost from above, with ``E[w] / E[w^2]`` of its mean curvature.
    variance : float
        Variance factor of the estimate: its covariance is this times the inverse of the weighted normal equations
        (Huber, Robust Statistics, 1981, section 7.6).
    """

    rays: Array
    residuals: Array
    by_point: Array
    by_lens: Array
    costs: Array
    relaxation: float
    variance: float

    @property
    def cost(self) -> float:
        """Cost of all points, pixels squared."""
        return float(self.costs.sum())

    def by_moving_point(self, problem: BundleProblem) -> Array:
        """Derivatives by points, zero for fixed ones: (2, 3, k)."""
        if problem.fixed is None:
            return self.by_point
        return np.where(problem.fixed[problem.point_row], 0.0, self.by_point)

    def where(self, observations: BoolArray, points: BoolArray, other: "Linearization") -> "Linearization":
        """Take some observations (k,) and points (q,) from another linearization with the same poses and lenses."""
        return replace(
            self,
            rays=np.where(observations, other.rays, self.rays),
            residuals=np.where(observations, other.residuals, self.residuals),
            by_point=np.where(observations, other.by_point, self.by_point),
            by_lens=np.where(observations, other.by_lens, self.by_lens),
            costs=np.where(points, other.costs, self.costs),
        )


def linearize(problem: BundleProblem, state: BundleState, loss_scale_px: float) -> Linearization:
    """Compute residuals, derivatives and costs.

    Parameters
    ----------
    problem : BundleProblem
    state : BundleState
    loss_scale_px : float
        Scale c of the loss ``c^2 log(1 + |r|^2 / c^2) / 2``.
    """
    count = len(problem.image_row)
    rays, local = np.empty((3, count)), np.empty((3, count))
    positions = np.take(np.ascontiguousarray(state.points.T), problem.point_row, axis=1)
    images = [slice(*ends) for ends in zip(problem.starts[:-1], problem.starts[1:], strict=True)]
    for image, own in enumerate(images):
        rays[:, own] = positions[:, own] - state.centers[image][:, None]
        local[:, own] = state.rotations[image] @ rays[:, own]
    distance = np.maximum(np.sqrt(np.einsum("ak,ak->k", local, local)), np.finfo(np.float64).tiny)
    width = problem.unknowns.shape[1] - 6
    residuals, by_ray, by_lens = np.empty((2, count)), np.empty((2, 3, count)), np.zeros((2, width, count))
    for idx, lens in enumerate(problem.lenses):
        own = slice(*problem.lens_starts[idx : idx + 2])
        units, parameters = np.ascontiguousarray((local[:, own] / distance[own]).T), state.parameters[idx]
        residuals[:, own] = (lens.project(parameters, units) - problem.keypoints[own]).T
        by_ray[:, :, own] = _derivative_by_ray(lens, parameters, units)
        by_lens[:, : len(lens.free), own] = _derivative_by_parameters(lens, parameters, units)
    by_ray /= distance
    by_point = np.empty_like(by_ray)
    for image, own in enumerate(images):
        by_point[:, :, own] = state.rotations[image].T @ by_ray[:, :, own]
    lost = ~(np.isfinite(residuals).all(axis=0) & np.isfinite(by_point).all(axis=(0, 1)))
    lost |= ~np.isfinite(by_lens).all(axis=(0, 1))
    if lost.any():
        residuals[:, lost] = LOST_PX / np.sqrt(2.0)
        by_point[:, :, lost], by_lens[:, :, lost] = 0.0, 0.0
    return _weighted(problem, rays, residuals, by_point, by_lens, len(state.points), loss_scale_px)


def _weighted(
    problem: BundleProblem,
    rays: Array,
    residuals: Array,
    by_point: Array,
    by_lens: Array,
    num_points: int,
    loss_scale_px: float,
) -> Linearization:
    norm = np.einsum("ak,ak->k", residuals, residuals)
    squared = norm / loss_scale_px**2
    weight = cauchy_weight(squared)
    costs = 0.5 * loss_scale_px**2 * np.bincount(problem.point_row, cauchy_loss(squared), minlength=num_points)
    # The loss's Hessian, averaged over the direction of a residual, is the square of its weight.
    mean, curvature = float(weight.mean()), float(np.square(weight).mean())
    spread = float((np.square(weight) * norm).mean()) / 2.0
    root = np.sqrt(weight)
    return Linearization(
        rays,
        root * residuals,
        root * by_point,
        root * by_lens,
        np.asarray(costs),
        relaxation=float(np.clip(mean / curvature, 1.0, MAX_RELAXATION)),
        variance=max(spread * mean / curvature**2, np.finfo(np.float64).tiny),
    )


def _derivative_by_ray(lens: Lens, parameters: Array, rays: Array) -> Array:
    """Derivatives (2, 3, k) of the projection of unit rays (k, 3)."""
    found = np.empty((2, 3, len(rays)))
    for axis in range(3):
        offset = DIFFERENCE * np.eye(3)[axis]
        ends = lens.project(parameters, rays + offset) - lens.project(parameters, rays - offset)
        found[:, axis] = ends.T / (2.0 * DIFFERENCE)
    return found


def _derivative_by_parameters(lens: Lens, parameters: Array, rays: Array) -> Array:
    """Derivatives (2, t, k) of the projection by the unknown parameters."""
    found = np.empty((2, len(lens.free), len(rays)))
    for slot, idx in enumerate(lens.free):
        offset = np.zeros(len(parameters))
        offset[idx] = DIFFERENCE * max(abs(parameters[idx]), 1.0)
        ends = lens.project(parameters + offset, rays) - lens.project(parameters - offset, rays)
        found[:, slot] = ends.T / (2.0 * offset[idx])
    return found
