"""Quaternions stored by component, (4, m) in the order x, y, z, w, for the inner loop of robust averaging.

Each component is one contiguous row, so that a product of 100,000 rotations is a few dozen vector operations; batched
3 x 3 products take several times longer.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3

Array = NDArray[np.float64]


def from_matrices(R: Array) -> Array:
    """Unit quaternions (4, m) of rotation matrices (m, 3, 3)."""
    return np.ascontiguousarray(so3.to_quaternion(R).T)


def to_matrices(q: Array) -> Array:
    """Rotation matrices (m, 3, 3) of quaternions (4, m), which are normalised first."""
    return so3.from_quaternion(q.T)


def conjugate(q: Array) -> Array:
    """Conjugates (4, m), the inverses of unit quaternions."""
    return np.stack([-q[0], -q[1], -q[2], q[3]])


def multiply(a: Array, b: Array) -> Array:
    """Hamilton products (4, m): the rotation a applied after b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    out = np.empty((4, max(a.shape[1], b.shape[1])))
    out[0] = aw * bx + ax * bw + ay * bz - az * by
    out[1] = aw * by - ax * bz + ay * bw + az * bx
    out[2] = aw * bz + ax * by - ay * bx + az * bw
    out[3] = aw * bw - ax * bx - ay * by - az * bz
    return out


def exp(w: Array) -> Array:
    """Unit quaternions (4, m) of rotation vectors (3, m), radians."""
    half = 0.5 * np.sqrt(np.einsum("am,am->m", w, w))
    small = half < 1e-6
    factor = np.where(small, 0.5 - half * half / 12.0, 0.5 * np.sin(half) / np.where(small, 1.0, half))
    return np.concatenate([factor * w, np.cos(half)[None]])


def log(q: Array) -> tuple[Array, Array]:
    """Rotation vectors (3, m) and their angles (m,) in [0, pi], radians, of unit quaternions (4, m)."""
    sine = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    angle = 2.0 * np.arctan2(sine, np.abs(q[3]))
    small = sine < 1e-10
    factor = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return np.copysign(factor, q[3]) * q[:3], angle
