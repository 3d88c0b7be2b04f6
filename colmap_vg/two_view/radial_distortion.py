"""Undistortion of padded rays by one radial term, with its derivative.

As in COLMAP's models, a point at normalised coordinates u is imaged at ``u (1 + k |u|^2)``. The derivative of u by the
term k is ``-u |u|^2 / (1 + 3 k |u|^2)``, that by the log focal length is ``-u``: a term moves a ray as the focal length
does, by a factor ("gain") of its own.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MIN_AXIAL = 0.3
"""Minimum cosine between the optical axis and a ray that is undistorted."""
_NEWTON_STEPS, _MIN_SLOPE, _PRECISION = 8, 0.1, 1e-15
"""Newton steps to undistort a radius, lower limit of the polynomial's slope in them, and change at which they end."""


def undistorted_rays(rays: Array, term: float, bent: BoolArray) -> tuple[Array, Array]:
    """Undistort unit rays.

    Rays far off the axis, where the polynomial is not valid, are returned unchanged, with gain 0; so is zero padding.

    Parameters
    ----------
    rays : (p, 3, length) array
    term : float
        Dimensionless.
    bent : (p,) bool array
        Pieces whose camera has the term.

    Returns
    -------
    rays : (p, 3, length) array
    gains : (p, length) array
        Shift of each ray by the term over that by the log focal length.
    """
    z = rays[:, 2]
    near = (z > MIN_AXIAL) & bent[:, None]
    distorted = np.where(near, np.hypot(rays[:, 0], rays[:, 1]) / np.where(near, z, 1.0), 0.0)
    radius = _undistorted_radii(distorted, term)
    factor = np.where(distorted > 0.0, radius / np.where(distorted > 0.0, distorted, 1.0), 1.0)
    length = np.sqrt(np.square(factor) * (1.0 - z * z) + z * z)
    result = rays * np.stack([factor, factor, np.ones_like(z)], axis=1) / length[:, None]
    squared = np.square(radius)
    slope = 1.0 + 3.0 * term * squared
    return result, np.where(slope > _MIN_SLOPE, squared / np.maximum(slope, _MIN_SLOPE), 0.0)


def _undistorted_radii(distorted: Array, term: float) -> Array:
    """Radii r of ``r (1 + term r^2) = distorted``."""
    if term == 0.0:
        return distorted
    # With a negative term the polynomial has a maximum, beyond which it is not invertible.
    limit = np.sqrt(-1.0 / (3.0 * term)) if term < 0.0 else np.inf
    radius = np.minimum(distorted, limit)
    for _ in range(_NEWTON_STEPS):
        squared = np.square(radius)
        step = (radius * (1.0 + term * squared) - distorted) / np.maximum(1.0 + 3.0 * term * squared, _MIN_SLOPE)
        radius = np.clip(radius - step, 0.0, limit)
        if np.abs(step).max(initial=0.0) < _PRECISION:
            break
    return radius
