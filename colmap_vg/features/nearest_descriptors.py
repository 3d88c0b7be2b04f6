"""Mutual nearest neighbours among descriptors: of whole images, along epipolar lines, or near predicted places.

Descriptors are bytes of norm near 512, so that products of two of them, sums of 128 integers below 2**16, are exact in
single precision: matches do not depend on the BLAS library, its threads, or the blocks in which they are computed.
"""

import numpy as np
from numpy.typing import NDArray

MAX_RATIO = 0.8
"""Of the distances to the nearest and the second nearest descriptor (Lowe, IJCV 2004, section 7.1), as in COLMAP."""
MAX_EPIPOLAR_RATIO = 0.65
"""The same among features near one epipolar line. They are few, so that a false nearest one passes 0.8 more often."""
MAX_SQUARED_DISTANCE = 2.0 - 2.0 * np.cos(0.7)
"""Of matching descriptors of norm 1: 0.7 radians, as in COLMAP."""
MAX_WINDOW_RATIO = 0.7
"""The same among features in a window about the predicted place, a fiftieth of the image."""
_SQUARED_NORM = np.float32(512.0**2)
_BLOCK_ROWS = 256
"""Descriptors whose products with those of another image are held at once; 8 MB with 8,192 of them."""
_NUM_BUNDLES = 32
"""Bundles of epipolar lines whose features are compared at once: fewer compare more features in vain, and more spend
their time in calls (0.01 s a pair of 7,000 features at 24 to 48)."""

_CELLS = 8
"""Columns, and rows in each, of the cells of features that are compared with a window at once."""

Bytes = NDArray[np.uint8]
Array = NDArray[np.float64]
Products = NDArray[np.float32]
IntArray = NDArray[np.int64]


def mutual_matches(descriptors1: Bytes, descriptors2: Bytes) -> IntArray:
    """Match descriptors that are each other's nearest and pass the ratio test in both images.

    Parameters
    ----------
    descriptors1, descriptors2 : (n, d), (m, d) uint8 array
        Of norm near 512; rows of zeros match nothing.

    Returns
    -------
    (k, 2) int64 array
        Rows of both, in the order of the first.
    """
    return more_mutual_matches(descriptors1, descriptors2, None)[0]


def more_mutual_matches(
    descriptors1: Bytes, descriptors2: Bytes, known: "Nearest | None"
) -> tuple[IntArray, "Nearest"]:
    """Match as :func:`mutual_matches` does, where the leading descriptors have been compared before.

    Parameters
    ----------
    descriptors1, descriptors2 : (n, d), (m, d) uint8 array
    known : Nearest or None
        Of the leading descriptors of both, which are not compared again.

    Returns
    -------
    matches : (k, 2) int64 array
        Rows of both, in the order of the first.
    nearest : Nearest
        To go on from with more descriptors.
    """
    known = known or Nearest(0, 0)
    best = known.extended(len(descriptors1), len(descriptors2))
    first, second = descriptors1.astype(np.float32), descriptors2.astype(np.float32)
    for rows, columns in (
        (range(known.num1), range(known.num2, len(second))),
        (range(known.num1, len(first)), range(len(second))),
    ):
        others = second[columns.start :].T
        for start in range(rows.start, rows.stop, _BLOCK_ROWS):
            block = np.arange(start, min(start + _BLOCK_ROWS, rows.stop))
            best.compare(block, np.asarray(columns), first[block] @ others)
    matches = best.matches(MAX_RATIO)
    # The other way only for what is left, which is far less.
    products = second[matches[:, 1]] @ first.T
    at = np.arange(len(matches))
    nearest = products[at, matches[:, 0]]
    products[at, matches[:, 0]] = 0.0
    return matches[_passes(nearest, products.max(axis=1, initial=0.0), MAX_RATIO)], best


def epipolar_matches(
    F: Array, points1: Array, points2: Array, descriptors1: Bytes, descriptors2: Bytes, max_error: float
) -> IntArray:
    """Match mutual nearest neighbours among features near each other's epipolar lines.

    Epipolar lines of image 2 pass through one point and differ by their angle about it. Features of image 1 are sorted
    by the angle of their lines and cut into bundles, and each is compared with the features of image 2 that lie within
    `max_error` of the bundle's lines.

    Parameters
    ----------
    F : (3, 3) array
        Fundamental matrix, ``x2^T F x1 = 0``.
    points1, points2 : (n, 2), (m, 2) array
        In any units.
    descriptors1, descriptors2 : (n, d), (m, d) uint8 array
    max_error : float
        Distance of matches from the epipolar line in image 2, in the units of `points2`.

    Returns
    -------
    (k, 2) int64 array
        Rows of both, in the order of the first.
    """
    best = Nearest(len(points1), len(points2))
    if not len(points1) or not len(points2):
        return best.matches(MAX_EPIPOLAR_RATIO)
    # Coordinates of image 2 of order one, where lines (a, b, c) of a pencil differ by comparable amounts in a, b and c.
    centre, size = points2.mean(axis=0), max(float(points2.std()), np.finfo(float).tiny)
    to_pixels = np.array([[size, 0.0, centre[0]], [0.0, size, centre[1]], [0.0, 0.0, 1.0]])
    F = to_pixels.T @ F
    x2 = _homogeneous((points2 - centre) / size)
    lines = _homogeneous(points1) @ F.T
    max_error = max_error / size
    a, b = np.linalg.svd(F)[0][:, :2].T  # the lines cos(t) a + sin(t) b all pass through the epipole
    of_lines = np.arctan2(lines @ b, lines @ a) % np.pi
    along_a, along_b = x2 @ a, x2 @ b
    of_points = np.arctan2(-along_a, along_b) % np.pi
    through = np.cos(of_points)[:, None] * a + np.sin(of_points)[:, None] * b
    # A point moves off its line by `per_angle` for each radian that the line turns; twice the bound for second order.
    per_angle = np.hypot(along_a, along_b) / np.maximum(np.hypot(through[:, 0], through[:, 1]), np.finfo(float).tiny)
    reach = 2.0 * max_error / np.maximum(per_angle, max_error)
    lines /= np.maximum(np.hypot(lines[:, 0], lines[:, 1]), np.finfo(float).tiny)[:, None]
    lines32, x32 = lines.astype(np.float32), x2.astype(np.float32)
    for rows in np.array_split(np.argsort(of_lines, kind="stable"), _NUM_BUNDLES):
        if not len(rows):
            continue
        low, high = of_lines[rows[0]], of_lines[rows[-1]]
        away = of_points - 0.5 * (low + high)
        away -= np.pi * np.rint(away / np.pi)
        near = np.flatnonzero(np.abs(away) <= 0.5 * (high - low) + reach)
        products = descriptors1[rows].astype(np.float32) @ descriptors2[near].astype(np.float32).T
        products *= np.abs(lines32[rows] @ x32[near].T) <= max_error  # faster than assignments by a mask
        best.compare(rows, near, products)
    return best.matches(MAX_EPIPOLAR_RATIO)


def homography_matches(
    H: Array, points1: Array, points2: Array, descriptors1: Bytes, descriptors2: Bytes, max_shift: float
) -> IntArray:
    """Match mutual nearest neighbours among features near where a homography takes them.

    Parameters
    ----------
    H : (3, 3) array
        Takes points of image 1 to image 2.
    points1, points2 : (n, 2), (m, 2) array
        Pixels.
    descriptors1, descriptors2 : (n, d), (m, d) uint8 array
    max_shift : float
        Largest difference of a coordinate from the predicted one, pixels. It leaves room for what is off the plane.

    Returns
    -------
    (k, 2) int64 array
        Rows of both, in the order of the first.
    """
    best = Nearest(len(points1), len(points2))
    taken = _homogeneous(points1) @ H.T
    seen = np.flatnonzero(np.abs(taken[:, 2]) > np.finfo(float).tiny)
    predicted = np.full((len(points1), 2), np.inf)
    predicted[seen] = taken[seen, :2] / taken[seen, 2:]
    predicted32, (x2, y2) = predicted.astype(np.float32), points2.astype(np.float32).T.copy()
    for column in np.array_split(seen[np.argsort(predicted[seen, 0], kind="stable")], _CELLS):
        for rows in np.array_split(column[np.argsort(predicted[column, 1], kind="stable")], _CELLS):
            if not len(rows):
                continue
            low, high = predicted[rows].min(axis=0) - max_shift, predicted[rows].max(axis=0) + max_shift
            near = np.flatnonzero((x2 >= low[0]) & (x2 <= high[0]) & (y2 >= low[1]) & (y2 <= high[1]))
            products = descriptors1[rows].astype(np.float32) @ descriptors2[near].astype(np.float32).T
            shift = np.abs(predicted32[rows, 0, None] - x2[near])
            np.maximum(shift, np.abs(predicted32[rows, 1, None] - y2[near]), out=shift)
            products *= shift <= max_shift
            best.compare(rows, near, products)
    return best.matches(MAX_WINDOW_RATIO)


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


class Nearest:
    """Products with the nearest and second nearest descriptors of image 1's features, and the nearest of image 2's.

    Attributes
    ----------
    num1, num2 : int
        Numbers of features.
    """

    def __init__(self, num1: int, num2: int) -> None:
        self.num1, self.num2 = num1, num2
        self._nearest = np.zeros(num1, np.int64)
        self._first, self._second = np.zeros(num1, np.float32), np.zeros(num1, np.float32)
        self._first_of_2 = np.zeros(num2, np.float32)

    def extended(self, num1: int, num2: int) -> "Nearest":
        """The same with more features behind those of both images, which are not compared yet."""
        more = Nearest(num1, num2)
        more._nearest[: self.num1], more._first_of_2[: self.num2] = self._nearest, self._first_of_2
        more._first[: self.num1], more._second[: self.num1] = self._first, self._second
        return more

    def compare(self, rows: IntArray, columns: IntArray, products: Products) -> None:
        """Record the products (r, c) of features `rows` of image 1 with `columns` of image 2, which come once."""
        if not len(rows) or not len(columns):
            return
        at, nearest = np.arange(len(rows)), products.argmax(axis=1)
        first, before = products[at, nearest], self._first[rows]
        self._nearest[rows] = np.where(first > before, columns[nearest], self._nearest[rows])
        self._first_of_2[columns] = np.maximum(self._first_of_2[columns], products.max(axis=0))
        products[at, nearest] = 0.0
        second = np.maximum(self._second[rows], products.max(axis=1))
        self._first[rows], self._second[rows] = np.maximum(first, before), np.maximum(second, np.minimum(first, before))

    def matches(self, max_ratio: float) -> IntArray:
        """Mutual nearest neighbours that pass the ratio test in image 1."""
        if not len(self._first_of_2):
            return np.empty((0, 2), np.int64)
        rows = np.flatnonzero((self._first > 0.0) & (self._first >= self._first_of_2[self._nearest]))
        rows = rows[_passes(self._first[rows], self._second[rows], max_ratio)]
        return np.stack([rows, self._nearest[rows]], axis=1)


def _passes(nearest: Products, second: Products, max_ratio: float) -> NDArray[np.bool_]:
    """Ratio and distance test on products; squared distances of unit vectors are 2 - 2 cos.

    Norms are a little more or less than 512: equal descriptors are at distance 0, and none of two is nearer.
    """
    first_squared, second_squared = (
        np.maximum(2.0 - 2.0 * product / _SQUARED_NORM, 0.0) for product in (nearest, second)
    )
    return np.asarray((first_squared < max_ratio**2 * second_squared) & (first_squared <= MAX_SQUARED_DISTANCE))
