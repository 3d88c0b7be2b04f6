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
MIN_AHEAD = 0.1
"""Minimum cosine between all rays and the optical axis for derivatives along the axis to follow from the others."""
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
    roots : (k,) array
        Roots of the weights; 0 where a point has no projection.
    residuals : (2, k) array
    by_point : (2, 3, k) array
    costs : (q,) array
        Cost of each point, pixels squared.
    relaxation : float
        Factor of steps. Weights bound the cost from above, with ``E[w] / E[w^2]`` of its mean curvature.
    variance : float
        Variance factor of the estimate: its covariance is this times the inverse of the weighted normal equations
        (Huber, Robust Statistics, 1981, section 7.6).
    """

    rays: Array
    roots: Array
    residuals: Array
    by_point: Array
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

    def change_to(self, other: "Linearization") -> Array:
        """Change (2, k) of the residuals to another state, with the weights of this one; 0 where either is lost."""
        known = other.roots > 0.0
        share = np.where(known, self.roots / np.where(known, other.roots, 1.0), 0.0)
        return np.asarray(share * other.residuals - np.where(known, self.residuals, 0.0))

    def where(self, observations: BoolArray, points: BoolArray, other: "Linearization") -> "Linearization":
        """Take some observations (k,) and points (q,) from another linearization with the same poses and lenses."""
        return replace(
            self,
            rays=np.where(observations, other.rays, self.rays),
            roots=np.where(observations, other.roots, self.roots),
            residuals=np.where(observations, other.residuals, self.residuals),
            by_point=np.where(observations, other.by_point, self.by_point),
            costs=np.where(points, other.costs, self.costs),
        )


def linearize(problem: BundleProblem, state: BundleState, loss_scale_px: float) -> Linearization:
    """Compute residuals, derivatives by points, and costs.

    Parameters
    ----------
    problem : BundleProblem
    state : BundleState
    loss_scale_px : float
        Scale c of the loss ``c^2 log(1 + |r|^2 / c^2) / 2``.

    Returns
    -------
    Linearization
    """
    positions = np.take(np.ascontiguousarray(state.points.T), problem.point_row, axis=1)
    rays = np.empty_like(positions)
    for image, own in enumerate(problem.of_images):
        rays[:, own] = positions[:, own] - state.centers[image][:, None]
    units, distance = _in_cameras(problem, state, rays)
    residuals, by_ray = np.empty((2, len(distance))), np.empty((2, 3, len(distance)))
    for idx, (lens, parameters) in enumerate(zip(problem.lenses, state.parameters, strict=True)):
        own = problem.of_lenses[idx]
        residuals[:, own] = (lens.project(parameters, units[own]) - problem.keypoints[own]).T
        by_ray[:, :, own] = _derivative_by_ray(lens, parameters, units[own])
    by_ray /= distance
    by_point = np.empty_like(by_ray)
    for image, own in enumerate(problem.of_images):
        by_point[:, :, own] = state.rotations[image].T @ by_ray[:, :, own]
    lost = ~(np.isfinite(residuals).all(axis=0) & np.isfinite(by_point).all(axis=(0, 1)))
    if lost.any():
        residuals[:, lost] = LOST_PX / np.sqrt(2.0)
        by_point[:, :, lost] = 0.0
    norm = np.einsum("ak,ak->k", residuals, residuals)
    squared = norm / loss_scale_px**2
    weight = cauchy_weight(squared)
    costs = np.bincount(problem.point_row, cauchy_loss(squared), minlength=len(state.points))
    # The loss's Hessian, averaged over the direction of a residual, is the square of its weight.
    mean, curvature = float(weight.mean()), float(np.square(weight).mean())
    spread = float((np.square(weight) * norm).mean()) / 2.0
    roots = np.where(lost, 0.0, np.sqrt(weight))
    return Linearization(
        rays,
        roots,
        roots * residuals,
        roots * by_point,
        np.asarray(0.5 * loss_scale_px**2 * costs),
        relaxation=float(np.clip(mean / curvature, 1.0, MAX_RELAXATION)),
        variance=max(spread * mean / curvature**2, np.finfo(np.float64).tiny),
    )


def derivatives_by_lens(problem: BundleProblem, state: BundleState, found: Linearization) -> Array:
    """Derivatives (2, t, k) of weighted residuals by the unknown parameters of each image's lens, padded with zeros."""
    units, _ = _in_cameras(problem, state, found.rays)
    derivatives = np.zeros((2, problem.unknowns.shape[1] - 6, len(units)))
    for idx, (lens, parameters) in enumerate(zip(problem.lenses, state.parameters, strict=True)):
        own = problem.of_lenses[idx]
        derivatives[:, : len(lens.free), own] = _derivative_by_parameters(lens, parameters, units[own])
    return np.asarray(found.roots * np.where(np.isfinite(derivatives), derivatives, 0.0))


def _in_cameras(problem: BundleProblem, state: BundleState, rays: Array) -> tuple[Array, Array]:
    """Unit rays (k, 3) in the frames of the cameras, and lengths (k,), of world rays (3, k)."""
    local = np.empty_like(rays)
    for image, own in enumerate(problem.of_images):
        local[:, own] = state.rotations[image] @ rays[:, own]
    distance = np.maximum(np.sqrt(np.einsum("ak,ak->k", local, local)), np.finfo(np.float64).tiny)
    return np.ascontiguousarray((local / distance).T), distance


def _derivative_by_ray(lens: Lens, parameters: Array, rays: Array) -> Array:
    """Derivatives (2, 3, k) of the projection of unit rays (k, 3).

    A projection does not change along its ray, so two axes tell the third unless that is nearly perpendicular to a ray.
    """
    found = np.empty((2, 3, len(rays)))
    ahead = float(np.abs(rays[:, 2]).min(initial=1.0)) > MIN_AHEAD
    for axis in range(2 if ahead else 3):
        offset = DIFFERENCE * np.eye(3)[axis]
        ends = lens.project(parameters, rays + offset) - lens.project(parameters, rays - offset)
        found[:, axis] = ends.T / (2.0 * DIFFERENCE)
    if ahead:
        found[:, 2] = -(found[:, 0] * rays[:, 0] + found[:, 1] * rays[:, 1]) / rays[:, 2]
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
