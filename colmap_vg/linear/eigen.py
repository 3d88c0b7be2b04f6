"""Smallest eigenvalues of large sparse symmetric matrices, each end checked: none below is missed.

Lanczos finds eigenvalues near a shift that lies below the whole spectrum. Where the matrix can be factored, the shift
is proven to lie below by the signs of the pivots (Sylvester's law of inertia). Large and dense matrices would fill
their factor; there plain Lanczos does, because densely linked graphs have wide gaps between their first eigenvalues.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize

Array = NDArray[np.float64]

RELATIVE_SHIFT = 1e-6
"""First distance of the shift below the expected bound, over the largest diagonal entry."""

FACTOR_LIMIT = 3_000
"""Up to this many rows a factor costs less than a second even when full."""
DENSE_ROW = 100
"""Entries in a mean row from which on larger matrices are not factored: Lanczos took 9 s where a factor took 64 s
(rotations of 5,433 cameras with 250 neighbours each)."""


def smallest_eigenpairs(
    matrix: sp.csc_array, num: int, lower_bound: float = 0.0, tolerance: float = 1e-8
) -> tuple[Array, Array]:
    """The algebraically smallest eigenvalues and their eigenvectors.

    Parameters
    ----------
    matrix : (n, n) csc_array
        Symmetric, both triangles stored.
    num : int
        How many, at most n.
    lower_bound : float
        Where the spectrum is thought to begin. It need not: the shift moves down until it is proven to lie below.
    tolerance : float
        Of the residuals of unfactored matrices, relative to the largest diagonal entry. Eigenvalues come from above
        and are better than that, by about its square over the gap.

    Returns
    -------
    values : (num,) array
        In rising order.
    vectors : (n, num) array
        Orthonormal columns.
    """
    n = matrix.shape[0]
    if num >= n - 1 or n <= 64:
        values, vectors = np.linalg.eigh(matrix.toarray())
        return values[:num], vectors[:, :num]
    start = np.random.default_rng(0).standard_normal(n)  # ARPACK's own start is not reproducible
    if n > FACTOR_LIMIT and matrix.nnz > DENSE_ROW * n:
        # Moved down by the largest diagonal entry: ARPACK's tolerance is relative, useless at eigenvalue zero.
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
    """A shift proven to lie below all eigenvalues, and the factor of the matrix minus it."""
    step = RELATIVE_SHIFT * float(np.abs(matrix.diagonal()).max() or 1.0)
    identity = sp.eye_array(matrix.shape[0], format="csc")
    while True:
        shift = lower_bound - step
        try:
            return shift, factorize(sp.csc_array(matrix - shift * identity), check_definite=True)
        except SingularMatrixError:
            step *= 8.0
