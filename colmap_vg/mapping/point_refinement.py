"""Points at the minimum of their reprojection errors while the cameras stand still: all points at once.

In the plane that touches the unit sphere at the observed ray ``u``, ``v = X - c`` is off by ``f B^T v / |v|`` pixels,
``B = tangent_basis(u)``: the reprojection error, of any lens, to first order. Damped Gauss-Newton steps under the
Cauchy loss of the bundle adjustment, each point with its own 3 x 3 system.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.linear.assembly import sum_at_nodes
from colmap_vg.linear.robust_losses import cauchy_loss, cauchy_weight

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-6
"""Share of the mean curvature added to all: a point whose rays are parallel stays where it is along them."""


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
    """Positions of points after steps that lower their robust reprojection errors.

    Parameters
    ----------
    positions : (q, 3) array
        To start from, world frame.
    point_row : (k,) int64 array
        Point of each observation.
    rays_world : (k, 3) array
        Unit rays of the observed keypoints.
    centers : (k, 3) array
        Projection centre of each observation's camera.
    focal_lengths : (k,) array
        Pixels.
    scale_px : float
        Cauchy scale.
    num_iterations : int

    Returns
    -------
    (q, 3) array
        A point that no step made better is where it was.
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
