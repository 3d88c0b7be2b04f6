"""Chordal rotation averaging as a quadratic form: ``f(X) = 6 sum w - tr(X^T W X)``.

X stacks the cam_from_world rotations, (3n, 3). W is the symmetric block matrix with ``w_ij R_ij`` at (j, i) and its
transpose at (i, j), so that ``sum w_ij ||R_ij - R_j R_i^T||_F^2`` equals f. Gradient, Hessian, certificate and spectral
initialisation are computed from products with W.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import sum_at_nodes

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def chordal_matrix(num_images: int, edges: IntArray, relative: Array, weights: Array) -> sp.bsr_array:
    """The matrix W, (3n, 3n), stored in 3 x 3 blocks."""
    rows = np.concatenate([edges[:, 1], edges[:, 0]])
    cols = np.concatenate([edges[:, 0], edges[:, 1]])
    blocks = weights[:, None, None] * relative
    unique, slot = np.unique(rows * num_images + cols, return_inverse=True)
    data = sum_at_nodes(len(unique), slot, np.concatenate([blocks, np.swapaxes(blocks, 1, 2)]))
    indptr = np.searchsorted(unique, np.arange(num_images + 1) * num_images)
    shape = (3 * num_images, 3 * num_images)
    return sp.bsr_array((data, unique % num_images, indptr), shape=shape)


def chordal_cost(edges: IntArray, relative: Array, weights: Array, R: Array) -> float:
    """``sum w_ij ||R_ij - R_j R_i^T||_F^2``, computed from the residuals to avoid cancellation near zero."""
    difference = relative @ R[edges[:, 0]] - R[edges[:, 1]]
    return float(np.einsum("k,kab,kab->", weights, difference, difference))


def block_diagonal(blocks: Array) -> sp.bsr_array:
    """Block-diagonal matrix (3n, 3n) of blocks (n, 3, 3)."""
    n = len(blocks)
    return sp.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))


class TangentQuadratic:
    """Gradient and Hessian of f at X under ``R_i <- R_i exp(v_i)``.

    With ``M_i = R_i^T (W X)_i``: gradient ``-4 vee(M_i)``, Hessian times v ``2 (tr(M_i) I - sym(M_i)) v_i - 4 vee(R_i^T
    (W V)_i)`` where ``V_i = R_i hat(v_i)``.
    """

    def __init__(self, W: sp.bsr_array, R: Array) -> None:
        self._W, self._R, self._Rt = W, R, np.swapaxes(R, 1, 2)
        M = self._Rt @ self._product(R)
        trace = np.trace(M, axis1=1, axis2=2)
        self.gradient = -4.0 * so3.vee(M)
        self._diagonal = 2.0 * (trace[:, None, None] * np.eye(3) - 0.5 * (M + np.swapaxes(M, 1, 2)))

    def hessian_times(self, v: Array) -> Array:
        """Hessian times a tangent vector (n, 3)."""
        turned = so3.vee(self._Rt @ self._product(self._R @ so3.hat(v)))
        return np.asarray(np.einsum("nab,nb->na", self._diagonal, v) - 4.0 * turned)

    def _product(self, blocks: Array) -> Array:
        return np.asarray((self._W @ blocks.reshape(-1, 3)).reshape(-1, 3, 3))
