"""Operations on arrays of vectors and unit vectors."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def normalized(v: Array) -> Array:
    """Vectors divided by their norm; zero vectors stay zero. (..., 3) to (..., 3)."""
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(v / np.where(norm > 0, norm, 1.0))


def angle_between(u: Array, v: Array) -> Array:
    """Angles in radians between vectors, accurate near 0 and pi: (..., 3), (..., 3) to (...)."""
    return np.asarray(np.arctan2(norm_of_cross(u, v), np.einsum("...i,...i->...", u, v)))


def norm_of_cross(u: Array, v: Array) -> Array:
    """Lengths (...) of the cross products of vectors (..., 3); without the products, a third of the time."""
    (a, b, c), (x, y, z) = np.moveaxis(u, -1, 0), np.moveaxis(v, -1, 0)
    return np.asarray(np.sqrt(np.square(b * z - c * y) + np.square(c * x - a * z) + np.square(a * y - b * x)))


def tangent_basis(v: Array) -> Array:
    """Orthonormal bases of the planes normal to unit vectors: (..., 3) to (..., 3, 2), without a singular direction.

    Duff et al., Building an orthonormal basis, revisited (JCGT 2017).
    """
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([first, second], axis=-1)
