"""One adapter to direct solvers for symmetric positive definite systems.

scipy's SuperLU is set up for such matrices (minimum degree on A + A^T, no pivoting off the diagonal), which is three to
four times faster than its default on viewing graphs. Where the matrix is tiny, or large and nearly full, LAPACK's
Cholesky wins.
"""

from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]

DENSE_BELOW = 300
"""Up to this many unknowns LAPACK, with one thread, is faster than building a sparse factor of any fill."""
DENSE_FILL, DENSE_LIMIT = 0.1, 12_000
"""From this share of nonzeros on, up to so many unknowns, LAPACK is faster than SuperLU: 29 against 88 ms on 1,000
full ones. At 7 % SuperLU takes 19 to 64 ms for 1,800 unknowns, by the share of long loops, and LAPACK 55 to 60."""


class Factor(Protocol):
    """A factored symmetric positive definite matrix."""

    def solve(self, b: Array) -> Array:
        """Solve ``A x = b`` for b of shape (n,) or (n, k)."""


class _CholeskyFactor:
    def __init__(self, matrix: Array) -> None:
        try:
            self._factor = scipy.linalg.cho_factor(matrix, lower=True, check_finite=False)
        except np.linalg.LinAlgError as error:
            raise SingularMatrixError(str(error)) from error

    def solve(self, b: Array) -> Array:
        return np.asarray(scipy.linalg.cho_solve(self._factor, b, check_finite=False))


class _SuperLUFactor:
    def __init__(self, matrix: sp.csc_array, check_definite: bool) -> None:
        try:
            self._factor = spla.splu(
                matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:  # SuperLU's word for an exactly singular matrix
            raise SingularMatrixError(str(error)) from error
        if check_definite:
            # Pivots have the signs of the eigenvalues (Sylvester) as long as rows and columns were permuted alike.
            f = self._factor
            if not (np.array_equal(f.perm_r, f.perm_c) and (f.U.diagonal() > 0).all()):
                raise SingularMatrixError("the matrix is not positive definite")

    def solve(self, b: Array) -> Array:
        return np.asarray(self._factor.solve(b))


class SingularMatrixError(GraphError):
    """The system is singular: part of the graph is not fixed by its edges."""


def factorize(matrix: sp.csc_array, *, check_definite: bool = False) -> Factor:
    """Factor a sparse symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) csc_array
        Both triangles stored.
    check_definite : bool
        Refuse indefinite matrices on the sparse path too, at the cost of a copy of the factor.

    Returns
    -------
    Factor

    Raises
    ------
    SingularMatrixError
        The matrix is not positive definite (dense path, or checked) or exactly singular (sparse path).
    """
    n = matrix.shape[0]
    fill = matrix.nnz / max(1, n * n)
    if n <= DENSE_BELOW or (fill >= DENSE_FILL and n <= DENSE_LIMIT):
        return _CholeskyFactor(matrix.toarray())
    return _SuperLUFactor(matrix, check_definite)
