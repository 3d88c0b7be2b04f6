"""Direct solvers for symmetric positive definite systems behind one interface.

scipy's SuperLU is configured for such matrices (minimum degree on A + A^T, no pivoting off the diagonal), which is
three to four times faster than its default on viewing graphs. For tiny matrices, and for large ones that are nearly
full or fill up, such as those of random graphs, LAPACK's Cholesky factorisation is faster.
"""

from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]

DENSE_BELOW = 300
"""Number of unknowns up to which LAPACK, with one thread, is faster than a sparse factorisation of any fill."""
DENSE_FILL, DENSE_LIMIT = 0.1, 12_000
"""Share of nonzeros above which, up to this number of unknowns, LAPACK is faster than SuperLU: 29 ms instead of 88 ms
for 1,000 unknowns and a full matrix. At 7 % and 1,800 unknowns SuperLU takes 19 to 64 ms, depending on the share of
long loops, and LAPACK 55 to 60 ms."""
DENSE_PROFILE = 0.65
"""Share of the entries within the profile, after reverse Cuthill-McKee ordering, above which the factor fills up and
LAPACK is faster, too: 170 ms instead of 550 ms for a random graph of 1,000 nodes of degree 20 with blocks of 3 (share
0.81, 2 % nonzeros). It is 0.04 for rings, 0.14 for grids, and 0.3 to 0.6 for photo collections with few nonzeros."""


class Factor(Protocol):
    """A factored symmetric positive definite matrix."""

    def solve(self, b: Array) -> Array:
        """Solve ``A x = b`` for b of shape (n,) or (n, k)."""


class _CholeskyFactor:
    def __init__(self, matrix: Array) -> None:
        """Factor a matrix in columns (Fortran's order) in its own memory."""
        try:
            self._factor = scipy.linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
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
        except RuntimeError as error:  # raised by SuperLU for exactly singular matrices
            raise SingularMatrixError(str(error)) from error
        if check_definite:
            # The pivots have the signs of the eigenvalues (Sylvester) if rows and columns were permuted alike.
            f = self._factor
            if not (np.array_equal(f.perm_r, f.perm_c) and (f.U.diagonal() > 0).all()):
                raise SingularMatrixError("the matrix is not positive definite")

    def solve(self, b: Array) -> Array:
        return np.asarray(self._factor.solve(b))


class SingularMatrixError(GraphError):
    """Raised for singular systems: the edges do not determine part of the graph."""


def factorize(matrix: sp.csc_array, *, check_definite: bool = False) -> Factor:
    """Factor a sparse symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) csc_array
        Both triangles stored.
    check_definite : bool
        Whether to reject indefinite matrices on the sparse path, too, at the cost of a copy of the factor.

    Returns
    -------
    Factor

    Raises
    ------
    SingularMatrixError
        The matrix is not positive definite (dense path, or checked) or exactly singular (sparse path).
    """
    n = matrix.shape[0]
    if n <= DENSE_BELOW or (n <= DENSE_LIMIT and (matrix.nnz >= DENSE_FILL * n * n or _fills_up(matrix))):
        return _CholeskyFactor(matrix.toarray(order="F"))
    return _SuperLUFactor(matrix, check_definite)


def _fills_up(matrix: sp.csc_array) -> bool:
    """Whether most entries lie between the first nonzero and the diagonal of their row in a band-reducing order."""
    n = matrix.shape[0]
    rank = np.empty(n, dtype=np.int64)
    rank[reverse_cuthill_mckee(sp.csr_matrix(matrix), symmetric_mode=True)] = np.arange(n)
    filled = np.flatnonzero(np.diff(matrix.indptr))
    first = np.minimum.reduceat(rank[matrix.indices], matrix.indptr[filled])
    return bool(np.maximum(rank[filled] - first, 0).sum() >= DENSE_PROFILE * n * n / 2.0)
