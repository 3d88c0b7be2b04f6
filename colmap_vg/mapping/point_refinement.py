"""Refine points by minimising their reprojection errors with fixed cameras, all points at once.

The residual of a point ``X`` seen from ``c`` along the unit ray ``u`` is ``f B^T v / |v|`` pixels, with ``v = X - c``
and ``B = tangent_basis(u)``: to first order the reprojection error of any camera model. Damped Gauss-Newton steps
minimise the bundle adjustment's Cauchy loss, with one 3 x 3 system per point.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.linear.assembly import sum_at_nodes
from colmap_vg.linear.robust_losses import cauchy_loss, cauchy_weight

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-6
"""Damping, as a share of the Hessian's mean eigenvalue: a point whose rays are parallel does not move along them."""


def refine_points(
    positions: Array,
    point_row: IntArray,
    rays_world: Array,
    centers: Array,
    focal_lengths: Array,
    *,
    scale_px: float = 1.0,
    num_iterations: int = 3,
) -> Array:
    """Refine positions of points by Gauss-Newton steps on their robust reprojection errors.

    Parameters
    ----------
    positions : (q, 3) array
        Initial positions, world frame.
    point_row : (k,) int64 array
        Point of each observation.
    rays_world : (k, 3) array
        Unit rays of the observed keypoints, world frame.
    centers : (k, 3) array
        Projection centre of each observation's camera, world frame.
    focal_lengths : (k,) array
        Pixels.
    scale_px : float
        Cauchy scale, pixels.
    num_iterations : int

    Returns
    -------
    (q, 3) array
        Refined positions, world frame; the initial one where no step lowered the cost.
    """
    q = len(positions)
    across = focal_lengths[:, None, None] * np.swapaxes(tangent_basis(rays_world), 1, 2)
    x, best, lowest = positions, positions, np.full(q, np.inf)
    for iteration in range(num_iterations + 1):
        v = x[point_row] - centers
        distance = np.maximum(np.linalg.norm(v, axis=1), np.finfo(np.float64).tiny)
        toward = v / distance[:, None]
        r = np.einsum("kab,kb->ka", across, toward)
        behind = np.einsum("ka,ka->k", toward, rays_world) <= 0.0
        squared = np.where(behind, np.inf, np.sum(r**2, axis=1) / scale_px**2)
        cost = np.bincount(point_row, weights=cauchy_loss(squared), minlength=q)
        better = cost < lowest
        best, lowest = np.where(better[:, None], x, best), np.where(better, cost, lowest)
        if iteration == num_iterations:
            break
        weight = cauchy_weight(squared) / distance**2
        J = across - r[:, :, None] * toward[:, None, :]
        hessian = sum_at_nodes(q, point_row, weight[:, None, None] * (np.swapaxes(J, 1, 2) @ J))
        gradient = sum_at_nodes(q, point_row, (weight * distance)[:, None] * np.einsum("kab,ka->kb", J, r))
        level = DAMPING * np.trace(hessian, axis1=1, axis2=2) / 3.0 + np.finfo(np.float64).tiny
        step = np.linalg.solve(hessian + level[:, None, None] * np.eye(3), gradient[:, :, None])[:, :, 0]
        x = np.where(better[:, None], x - step, best)
    return best
