"""Smallest eigenvalues of large sparse symmetric matrices, without missing any.

Shift-invert Lanczos finds the eigenvalues closest to a shift below the whole spectrum. The signs of the pivots of the
factorisation prove that the shift is below (Sylvester's law of inertia). For large, rather dense matrices, whose
factors fill in, plain Lanczos is used, since densely connected graphs have wide gaps between their first eigenvalues.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize

Array = NDArray[np.float64]

RELATIVE_SHIFT = 1e-6
"""Initial distance of the shift below the expected bound, as a share of the largest diagonal entry."""

FACTOR_LIMIT = 3_000
"""Number of rows up to which matrices are always factored, in less than a second even if full."""
DENSE_ROW = 100
"""Mean number of entries per row above which larger matrices are not factored: Lanczos took 9 s where factorisation
took 64 s (rotations of 5,433 cameras with 250 neighbours each)."""


def smallest_eigenpairs(
    matrix: sp.csc_array, num: int, lower_bound: float = 0.0, tolerance: float = 1e-8
) -> tuple[Array, Array]:
    """Compute the algebraically smallest eigenvalues and their eigenvectors.

    Parameters
    ----------
    matrix : (n, n) csc_array
        Symmetric, both triangles stored.
    num : int
        Number of eigenvalues, at most n.
    lower_bound : float
        Expected lower bound of the spectrum. It need not hold: the shift is lowered until it is proven to be below.
    tolerance : float
        Residual at convergence if the matrix is not factored, relative to the largest diagonal entry. Eigenvalues are
        approached from above and are more accurate, to about its square over the gap.

    Returns
    -------
    values : (num,) array
        In increasing order.
    vectors : (n, num) array
        Orthonormal columns.
    """
    n = matrix.shape[0]
    if num >= n - 1 or n <= 64:
        values, vectors = np.linalg.eigh(matrix.toarray())
        return values[:num], vectors[:, :num]
    start = np.random.default_rng(0).standard_normal(n)  # ARPACK's default start is not reproducible
    if n > FACTOR_LIMIT and matrix.nnz > DENSE_ROW * n:
        # Shift by the largest diagonal entry, since ARPACK's tolerance is relative to eigenvalues, which may be zero.
        moved = float(np.abs(matrix.diagonal()).max() or 1.0)
        lowered = sp.csc_array(matrix - moved * sp.eye_array(n))
        values, vectors = spla.eigsh(lowered, num, which="SA", v0=start, ncv=max(4 * num, 40), tol=tolerance)
        values = values + moved
    else:
        shift, factor = _shift_below(matrix, lower_bound)
        inverse = spla.LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
        values, vectors = spla.eigsh(matrix, num, sigma=shift, which="LM", OPinv=inverse, v0=start)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _shift_below(matrix: sp.csc_array, lower_bound: float) -> tuple[float, Factor]:
    """A shift that is proven to be below all eigenvalues, and the factorisation of the shifted matrix."""
    step = RELATIVE_SHIFT * float(np.abs(matrix.diagonal()).max() or 1.0)
    identity = sp.eye_array(matrix.shape[0], format="csc")
    while True:
        shift = lower_bound - step
        try:
            return shift, factorize(sp.csc_array(matrix - shift * identity), check_definite=True)
        except SingularMatrixError:
            step *= 8.0
