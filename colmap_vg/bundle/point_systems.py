"""The 3 x 3 normal equations of all points, factored by Cholesky at once, component by component."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-12
"""Share of the trace that is added to the diagonal: a point whose rays are parallel does not move along them. Much more
of it holds back what moves many points at once, as the bend of a long street: 1e-7 took fifty steps for two."""
_COMPONENTS = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2))
"""Rows and columns of the lower triangle, in the order of a factor's components."""


@dataclass(frozen=True, eq=False)
class PointFactors:
    """Lower triangular factors of the normal equations of q points.

    Attributes
    ----------
    components : (6, q) array
        Entries of the lower triangles, column by column.
    """

    components: Array

    def lower(self, values: Array) -> Array:
        """Solve ``L x = b`` for values (3, q)."""
        a, b, c, d, e, f = self.components
        x = values[0] / a
        y = (values[1] - b * x) / d
        return np.stack([x, y, (values[2] - c * x - e * y) / f])

    def upper(self, values: Array) -> Array:
        """Solve ``L^T x = b`` for values (3, q)."""
        a, b, c, d, e, f = self.components
        z = values[2] / f
        y = (values[1] - e * z) / d
        return np.stack([(values[0] - b * y - c * z) / a, y, z])

    def at(self, rows: IntArray) -> "PointFactors":
        """Factors of some points, with repetitions."""
        return PointFactors(np.take(self.components, rows, axis=1))


def factored(num_points: int, point_row: IntArray, by_point: Array) -> PointFactors:
    """Factor the normal equations ``sum A^T A`` of points.

    Parameters
    ----------
    num_points : int
    point_row : (k,) int64 array
    by_point : (2, 3, k) array
        Derivative A of each weighted residual by its point.
    """
    products = (np.einsum("ak,ak->k", by_point[:, i], by_point[:, j]) for i, j in _COMPONENTS)
    return cholesky(sums_at_points(num_points, point_row, products))


def cholesky(components: Array) -> PointFactors:
    """Factor symmetric 3 x 3 matrices, given by the entries of their lower triangles, column by column: (6, q)."""
    xx, xy, xz, yy, yz, zz = components
    tiny = np.finfo(np.float64).tiny
    level = DAMPING * (xx + yy + zz) + tiny
    a = np.sqrt(xx + level)
    b, c = xy / a, xz / a
    d = np.sqrt(np.maximum(yy + level - b * b, tiny))
    e = (yz - b * c) / d
    f = np.sqrt(np.maximum(zz + level - c * c - e * e, tiny))
    return PointFactors(np.stack([a, b, c, d, e, f]))


def gradients(num_points: int, point_row: IntArray, by_point: Array, residuals: Array) -> Array:
    """Gradients (3, q) of the cost by points, for derivatives (2, 3, k) and residuals (2, k)."""
    products = (np.einsum("ak,ak->k", by_point[:, axis], residuals) for axis in range(3))
    return sums_at_points(num_points, point_row, products)


def sums_at_points(num_points: int, point_row: IntArray, values: Iterable[Array]) -> Array:
    """Sums (c, q) of c values of each observation (k,) over those of each point."""
    return np.array([np.bincount(point_row, row, num_points) for row in values], dtype=np.float64)
