"""Residuals of directions at an outlier-robust fit of positions.

Least unsquared deviations, a convex problem, give initial positions that gross outliers do not fold. Steps of Alg. 1O
with Geman-McClure weights of decreasing scale on the chordal distance between measured and solved directions then
remove the influence of outliers.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.directions import angle_between
from colmap_vg.linear.laplacian import LaplacianSystem
from colmap_vg.linear.robust_losses import geman_mcclure_weight
from colmap_vg.positions.fixed_point import edge_lengths
from colmap_vg.positions.lud import solve_lud
from colmap_vg.positions.result import centered, spread, unit_weights

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

LUD_TOLERANCE = 1e-2
"""Relative duality gap of LUD: initial positions need no more."""
SCALES_DEG = (20.0, 14.0, 10.0, 7.0, 5.0)
"""Successive Geman-McClure scales, degrees; the last is COLMAP's default for rotations."""
ITERATIONS_PER_SCALE = 6
"""Steps of Alg. 1O at each scale."""


def robust_direction_residuals(
    num_images: int, edges: IntArray, directions_world: Array, weights: Array | None = None
) -> tuple[Array, Array]:
    """Fit positions robustly to directions, and compute the angle of each direction to them.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of squared residuals, default 1.

    Returns
    -------
    projection_centers : (n, 3) array
    angles : (m,) array
        Angles between measured and solved directions, radians.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    w = unit_weights(weights, len(edges))
    p = solve_lud(num_images, edges, directions_world, w, tolerance=LUD_TOLERANCE).projection_centers
    size = spread(p)
    system = LaplacianSystem(num_images, edges)
    for scale in np.repeat(2.0 * np.sin(np.radians(SCALES_DEG) / 2.0), ITERATIONS_PER_SCALE):
        distance = _chordal(p, edges, directions_world, size)
        p = _direction_step(system, p, edges, directions_world, w * geman_mcclure_weight((distance / scale) ** 2), size)
    return p, angle_between(directions_world, p[edges[:, 1]] - p[edges[:, 0]])


def _chordal(p: Array, edges: IntArray, directions: Array, size: float) -> Array:
    d = p[edges[:, 1]] - p[edges[:, 0]]
    return np.asarray(np.linalg.norm(directions - d / edge_lengths(p, edges, size)[:, None], axis=1))


def _direction_step(
    system: LaplacianSystem, p: Array, edges: IntArray, directions: Array, weights: Array, size: float
) -> Array:
    """One step of Alg. 1O: LS2 at the edge lengths of p."""
    length = edge_lengths(p, edges, size)
    # Lengths have a lower limit of a thousandth of the median, so that weights of vanishing edges do not dominate.
    length = np.maximum(length, 1e-3 * np.median(length))
    new = centered(system.factor(weights / length**2).solve(system.right_side(weights / length, directions)))
    return np.asarray(new * (size / spread(new)))
