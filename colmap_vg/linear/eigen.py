"""Smallest eigenvalues of large sparse symmetric matrices, each end checked: none below is missed.

Lanczos finds eigenvalues near a shift that lies below the whole spectrum. Where the matrix can be factored, the shift
is proven to lie below by the signs of the pivots (Sylvester's law of inertia); where the factor would be too large,
which is where graphs are dense and spectral gaps wide, plain Lanczos does.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from colmap_vg.linear.solvers import DENSE_FILL, DENSE_FILL_LIMIT, Factor, SingularMatrixError, factorize

Array = NDArray[np.float64]

RELATIVE_SHIFT = 1e-6
"""First distance of the shift below the expected bound, over the largest diagonal entry."""


def smallest_eigenpairs(matrix: sp.csc_array, num: int, lower_bound: float = 0.0) -> tuple[Array, Array]:
    """The algebraically smallest eigenvalues and their eigenvectors.

    Parameters
    ----------
    matrix : (n, n) csc_array
        Symmetric, both triangles stored.
    num : int
        How many, at most n.
    lower_bound : float
        Where the spectrum is thought to begin. It need not: the shift moves down until it is proven to lie below.

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
    if n > DENSE_FILL_LIMIT and matrix.nnz >= DENSE_FILL * n * n:
        values, vectors = spla.eigsh(matrix, num, which="SA", v0=start, ncv=min(n, max(4 * num, 40)))
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
