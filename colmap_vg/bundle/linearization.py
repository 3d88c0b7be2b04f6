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

from colmap_vg.bundle.problem import BundleProblem, BundleState, Lens, Run
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
        With an observation at least.
    state : BundleState
    loss_scale_px : float
        Scale c of the loss ``c^2 log(1 + |r|^2 / c^2) / 2``.

    Returns
    -------
    Linearization
    """
    k, points = len(problem.point_row), np.ascontiguousarray(state.points.T)
    rays, roots, losses = np.empty((3, k)), np.empty(k), np.empty(k)
    residuals, by_point = np.empty((2, k)), np.empty((2, 3, k))
    total, squares, spread = 0.0, 0.0, 0.0
    for run in problem.runs:
        own = run.observations
        rays[:, own], r, A = _by_points(problem, state, points, run)
        lost = ~(np.isfinite(r).all(axis=0) & np.isfinite(A).all(axis=(0, 1)))
        if lost.any():
            r[:, lost] = LOST_PX / np.sqrt(2.0)
            A[:, :, lost] = 0.0
        norm = np.einsum("ak,ak->k", r, r)
        squared = norm / loss_scale_px**2
        weight = cauchy_weight(squared)
        roots[own] = np.where(lost, 0.0, np.sqrt(weight))
        np.multiply(r, roots[own], out=residuals[:, own])
        np.multiply(A, roots[own], out=by_point[:, :, own])
        losses[own] = cauchy_loss(squared)
        # The loss's Hessian, averaged over the direction of a residual, is the square of its weight.
        square = np.square(weight)
        total, squares = total + float(weight.sum()), squares + float(square.sum())
        spread += float((square * norm).sum()) / 2.0
    costs = np.bincount(problem.point_row, losses, minlength=len(state.points))
    return Linearization(
        rays,
        roots,
        residuals,
        by_point,
        np.asarray(0.5 * loss_scale_px**2 * costs),
        relaxation=float(np.clip(total / squares, 1.0, MAX_RELAXATION)),
        variance=max(spread * total / squares**2, np.finfo(np.float64).tiny),
    )


def _by_points(problem: BundleProblem, state: BundleState, points: Array, run: Run) -> tuple[Array, Array, Array]:
    """World rays (3, k), residuals (2, k) and their derivatives by points (2, 3, k) of a run, for points (3, q)."""
    rays = np.take(points, problem.point_row[run.observations], axis=1)
    for image, at in enumerate(run.of_images, run.first):
        rays[:, at] -= state.centers[image][:, None]
    units, distance = _in_cameras(state, run, rays)
    lens, parameters = problem.lenses[run.lens], state.parameters[run.lens]
    residuals = (lens.project(parameters, units) - problem.keypoints[run.observations]).T
    by_ray = _derivative_by_ray(lens, parameters, units)
    by_ray /= distance
    for image, at in enumerate(run.of_images, run.first):
        by_ray[:, :, at] = state.rotations[image].T @ by_ray[:, :, at]
    return rays, residuals, by_ray


def derivatives_by_lens(problem: BundleProblem, state: BundleState, found: Linearization) -> Array:
    """Derivatives (2, t, k) of weighted residuals by the unknown parameters of each image's lens, padded with zeros."""
    derivatives = np.zeros((2, problem.unknowns.shape[1] - 6, len(found.roots)))
    for run in problem.runs:
        own, lens = run.observations, problem.lenses[run.lens]
        if len(lens.free):
            units, _ = _in_cameras(state, run, found.rays[:, own])
            by_lens = _derivative_by_parameters(lens, state.parameters[run.lens], units)
            derivatives[:, : len(lens.free), own] = found.roots[own] * np.where(np.isfinite(by_lens), by_lens, 0.0)
    return derivatives


def _in_cameras(state: BundleState, run: Run, rays: Array) -> tuple[Array, Array]:
    """Unit rays (k, 3) in the frames of the cameras, and lengths (k,), of a run's world rays (3, k)."""
    local = np.empty_like(rays)
    for image, at in enumerate(run.of_images, run.first):
        local[:, at] = state.rotations[image] @ rays[:, at]
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
