"""Rotations in batches: exponential, logarithm, projection and angle on ``(..., 3, 3)`` arrays.

Implemented in numpy because scipy's ``Rotation``, against which it is tested, is several times slower on hundreds of
thousands of edges. All angles are in radians. Tangent vectors are rotation vectors applied on the left,
``R <- exp(w) R``, unless a function says otherwise.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def hat(w: Array) -> Array:
    """Skew-symmetric matrix of a vector: ``hat(w) @ v == np.cross(w, v)``.

    Parameters
    ----------
    w : (..., 3) array

    Returns
    -------
    (..., 3, 3) array
    """
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return W


def vee(W: Array) -> Array:
    """Inverse of :func:`hat`, on the skew-symmetric part of W: (..., 3, 3) to (..., 3)."""
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def exp(w: Array) -> Array:
    """Rotation matrices of rotation vectors (Rodrigues), exact to rounding for angles down to zero.

    Parameters
    ----------
    w : (..., 3) array
        Rotation vectors, radians.

    Returns
    -------
    (..., 3, 3) array
    """
    squared = np.einsum("...i,...i->...", w, w)
    angle = np.sqrt(squared)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - squared / 6.0, np.sin(safe) / safe)
    half = np.sin(0.5 * safe) / safe
    b = np.where(small, 0.5 - squared / 24.0, 2.0 * half * half)
    W = hat(w)
    return np.asarray(np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W))


def to_quaternion(R: Array) -> Array:
    """Unit quaternions (x, y, z, w), w >= 0, of rotation matrices: (..., 3, 3) to (..., 4).

    The largest of the four components is computed from the diagonal (Shepperd), to avoid cancellation near angle pi.
    """
    m = R.reshape(-1, 3, 3)
    trace = np.trace(m, axis1=1, axis2=2)
    # Row k of the symmetric matrix 4 q q^T, for all k; the best-conditioned row is the one of the largest diagonal.
    K = np.empty((len(m), 4, 4))
    for i in range(3):
        K[:, i, i] = 1.0 + 2.0 * m[:, i, i] - trace
    K[:, 3, 3] = 1.0 + trace
    for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        K[:, i, j] = K[:, j, i] = m[:, i, j] + m[:, j, i]
        sign = 1.0 if (i, j) != (0, 2) else -1.0
        K[:, k, 3] = K[:, 3, k] = sign * (m[:, j, i] - m[:, i, j])
    best = np.argmax(np.einsum("nii->ni", K), axis=1)
    q = K[np.arange(len(m)), best]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(q[:, 3:] < 0, -q, q)
    return np.asarray(q.reshape(*R.shape[:-2], 4))


def from_quaternion(q: Array) -> Array:
    """Rotation matrices of quaternions (x, y, z, w), normalised first: (..., 4) to (..., 3, 3)."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3]
    V = hat(v)
    return np.asarray(np.eye(3) + 2.0 * (w[..., None, None] * V + V @ V))


def log(R: Array) -> Array:
    """Rotation vectors of rotation matrices, accurate near angles 0 and pi.

    Parameters
    ----------
    R : (..., 3, 3) array
        Rotation matrices.

    Returns
    -------
    (..., 3) array
        Rotation vectors of norm at most pi, radians.
    """
    q = to_quaternion(R)
    v, w = q[..., :3], q[..., 3]
    sine = np.linalg.norm(v, axis=-1)
    small = sine < 1e-8
    factor = np.where(small, 2.0, 2.0 * np.arctan2(sine, w) / np.where(small, 1.0, sine))
    return np.asarray(factor[..., None] * v)


def left_jacobian_inverse(w: Array) -> Array:
    """Derivative of ``log(exp(v) exp(w))`` by v at v = 0: (..., 3) to (..., 3, 3); norms below 2 pi.

    ``I - W/2 + (1 - (a/2) cot(a/2)) / a^2 W^2`` with ``W = hat(w)``, ``a = ||w||`` (Chirikjian; Sola et al., eq. 146).
    """
    squared = np.einsum("...i,...i->...", w, w)
    small = squared < 1e-4
    half = 0.5 * np.sqrt(np.where(small, 1.0, squared))
    series = 1.0 / 12.0 + squared / 720.0 + squared * squared / 30240.0
    factor = np.where(small, series, (1.0 - half / np.tan(half)) / (4.0 * half * half))
    W = hat(w)
    return np.asarray(np.eye(3) - 0.5 * W + factor[..., None, None] * (W @ W))


def angle(R: Array) -> Array:
    """Rotation angles in radians, accurate near 0 and pi: (..., 3, 3) to (...)."""
    sine = np.linalg.norm(vee(R), axis=-1)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def project(M: Array) -> Array:
    """Nearest rotations in the Frobenius norm, by SVD with the sign of the determinant on the last axis.

    Parameters
    ----------
    M : (..., 3, 3) array

    Returns
    -------
    (..., 3, 3) array
    """
    U, _, Vt = np.linalg.svd(M)
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return np.asarray(U @ Vt)


def random(num: int, rng: np.random.Generator) -> Array:
    """Uniformly random rotations, (num, 3, 3)."""
    return from_quaternion(rng.standard_normal((num, 4)))


def perturbed(R: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Rotations times isotropic normal noise of standard deviation sigma (radians) in each tangent axis."""
    return np.asarray(exp(sigma * rng.standard_normal((*R.shape[:-2], 3))) @ R)
