"""Triangulation of all tracks at once, with the poses fixed.

Most tracks are one point each: the point with the least sum of squared sines of angles to all rays lies near each of
them. Tracks that a false match joins are taken apart: of the points of their matched pairs, the one near most rays is
taken, and what remains is split anew.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.bundle.point_systems import cholesky, sums_at_points
from colmap_vg.bundle.tracks import MAX_ANGLE, MatchedRays, connected_tracks, consistent_matches

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

NUM_HYPOTHESES = 12
"""Number of matched pairs whose points are tried in a track that is not one point."""
MAX_NUM_ROUNDS = 30
"""Maximum number of points that are taken from a track before what remains of it is given up."""
NEAREST = 1e-12
"""Least squared distance of a point from a centre, over the mean of all."""
NUM_WEIGHTINGS = 2
"""Number of solutions for a point: the first weighs all rays alike, the next ones by the distances found before."""


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Points of tracks.

    Attributes
    ----------
    positions : (3, q) array
        World frame.
    point_row : (k,) int64 array
        Point of each keypoint; -1 without one.
    """

    positions: Array
    point_row: IntArray


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of some keypoints, sorted by track.

    Attributes
    ----------
    rows : (r,) int64 array
        The keypoints.
    track : (r,) int64 array
        From zero to t - 1, none without a ray.
    rays, centers : (3, r) array
    images : (r,) int64 array
    """

    rows: IntArray
    track: IntArray
    rays: Array
    centers: Array
    images: IntArray

    @classmethod
    def of(cls, seen: MatchedRays, rows: IntArray, track: IntArray) -> "_Rays":
        order = np.argsort(track, kind="stable")
        rows, track = rows[order], track[order]
        images = seen.image_row[rows]
        track = np.cumsum(np.diff(track, prepend=track[:1]) != 0)
        return cls(rows, track, np.take(seen.rays, rows, axis=1), np.take(seen.centers, images, axis=1), images)

    def subset(self, kept: BoolArray) -> "_Rays":
        """Some of the rays (r,); tracks keep their numbers."""
        return _Rays(self.rows[kept], self.track[kept], self.rays[:, kept], self.centers[:, kept], self.images[kept])

    @property
    def num_tracks(self) -> int:
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def has(self, fits: BoolArray) -> BoolArray:
        """Whether two rays (r,) or more of each track fit: (t,)."""
        return np.asarray(np.bincount(self.track, fits, self.num_tracks) >= 2)


def triangulate(seen: MatchedRays, min_angle: float) -> TriangulatedPoints:
    """Triangulate the points that matched keypoints have in common.

    Two keypoints that are matched to each other only make no point.

    Parameters
    ----------
    seen : MatchedRays
    min_angle : float
        Minimum angle between two rays of a point, radians.

    Returns
    -------
    TriangulatedPoints
        Each is seen by two images or more, and at most once by each.
    """
    k = len(seen.image_row)
    degree = np.bincount(seen.matches.ravel(), minlength=k)
    matches = seen.matches[:, consistent_matches(seen) & (degree[seen.matches].max(axis=0) > 1)]
    point_row, positions, count = np.full(k, -1), [np.zeros((3, 0))], 0
    remaining = np.ones(k, dtype=bool)
    for number in range(MAX_NUM_ROUNDS):
        if not matches.shape[1]:
            break
        track = connected_tracks(matches, k)
        rows = np.flatnonzero(track >= 0)
        tracks = _Rays.of(seen, rows, track[rows])
        if number == 0:
            found, fits = _of_whole_tracks(tracks)
        else:
            found, fits = _of_matched_pairs(tracks, matches, k)
            # A track without a point that two rays fit is given up.
            remaining[tracks.rows[~tracks.has(fits)[tracks.track]]] = False
        remaining[tracks.rows[fits]] = False
        used = tracks.subset(fits & _is_wide(tracks, fits, min_angle)[tracks.track])
        new = np.flatnonzero(np.bincount(used.track, minlength=tracks.num_tracks))
        point_row[used.rows] = count + np.searchsorted(new, used.track)
        positions.append(found[:, new])
        count += len(new)
        matches = matches[:, remaining[matches].all(axis=0)]
    return TriangulatedPoints(np.concatenate(positions, axis=1), point_row)


def _of_whole_tracks(tracks: _Rays) -> tuple[Array, BoolArray]:
    """Points of tracks (3, t), and the rays (r,) of tracks all of whose rays fit, from images of their own."""
    positions = nearest_points(tracks.rays, tracks.centers, tracks.track, tracks.num_tracks)
    off, ahead = _deviations(tracks, positions)
    fits = ahead & (off <= np.sin(MAX_ANGLE) ** 2)
    whole = np.bincount(tracks.track, ~fits, tracks.num_tracks) == 0
    num_images = int(tracks.images.max(initial=0)) + 1
    sights = np.sort(tracks.track * num_images + tracks.images)
    whole[sights[~_starts(sights)] // num_images] = False
    return positions, whole[tracks.track]


def _of_matched_pairs(tracks: _Rays, matches: IntArray, num_keypoints: int) -> tuple[Array, BoolArray]:
    """Of the points of some matched pairs of each track the one that most rays fit (3, t), and these rays (r,)."""
    t = tracks.num_tracks
    place = np.zeros(num_keypoints, dtype=np.int64)
    place[tracks.rows] = np.arange(len(tracks.rows))
    ends = place[matches]
    ends = ends[:, np.argsort(tracks.track[ends[0]], kind="stable")]
    starts = np.searchsorted(tracks.track[ends[0]], np.arange(t + 1))
    count = np.diff(starts)
    best, highest = np.zeros((3, t)), np.zeros(t)
    for number in range(NUM_HYPOTHESES):
        tried = np.flatnonzero(count > number)
        if not len(tried):
            break
        spread = np.where(count > NUM_HYPOTHESES, number * count // NUM_HYPOTHESES, number)
        pair = ends[:, (starts[:-1] + spread)[tried]]
        positions = np.full((3, t), np.nan)
        positions[:, tried] = nearest_points(
            tracks.rays[:, pair.T.ravel()],
            tracks.centers[:, pair.T.ravel()],
            np.repeat(np.arange(len(tried)), 2),
            len(tried),
        )
        off, ahead = _deviations(tracks, positions)
        share = np.where(ahead, np.maximum(1.0 - off / np.sin(MAX_ANGLE) ** 2, 0.0), 0.0)
        score = np.bincount(tracks.track, share, t)
        better = score > highest
        best, highest = np.where(better, positions, best), np.where(better, score, highest)
    off, ahead = _deviations(tracks, best)
    fits = ahead & (off < np.sin(MAX_ANGLE) ** 2) & (highest > 0.0)[tracks.track]
    fits[fits] = _is_nearest(tracks.subset(fits), off[fits])
    return _again(tracks, best, fits)


def _again(tracks: _Rays, found: Array, fits: BoolArray) -> tuple[Array, BoolArray]:
    """Points anew from the rays that fit, one of each image, and those of them that still do."""
    used = tracks.subset(fits)
    positions = nearest_points(used.rays, used.centers, used.track, tracks.num_tracks)
    positions = np.where(np.bincount(used.track, minlength=tracks.num_tracks) > 1, positions, found)
    off, ahead = _deviations(used, positions)
    still = np.zeros_like(fits)
    still[fits] = ahead & (off <= np.sin(MAX_ANGLE) ** 2)
    return positions, still & tracks.has(still)[tracks.track]


def nearest_points(rays: Array, centers: Array, track: IntArray, num_tracks: int) -> Array:
    """Points (3, t) that nearly minimise the squared sines of angles to rays (3, r) from centres (3, r), by track."""
    count = np.maximum(np.bincount(track, minlength=num_tracks), 1)
    positions = sums_at_points(num_tracks, track, centers) / count
    weights = np.ones(len(track))
    for number in range(NUM_WEIGHTINGS):
        away = positions[:, track] - centers
        if number > 0:
            squared = np.einsum("ak,ak->k", away, away)
            weights = 1.0 / np.maximum(
                squared, NEAREST * squared.sum() / max(len(squared), 1) + np.finfo(np.float64).tiny
            )
        # Across the ray: w (I - u u^T).
        x, y, z = rays
        products = np.stack([1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z])
        factors = cholesky(sums_at_points(num_tracks, track, weights * products))
        across = weights * (away - np.einsum("ak,ak->k", away, rays) * rays)
        positions = positions - factors.upper(factors.lower(sums_at_points(num_tracks, track, across)))
    return positions


def _deviations(tracks: _Rays, positions: Array) -> tuple[Array, BoolArray]:
    """Squared sines of the angles between rays (r,) and the points of their tracks, and whether these are ahead."""
    away = positions[:, tracks.track] - tracks.centers
    along = np.einsum("ak,ak->k", away, tracks.rays)
    squared = np.maximum(np.einsum("ak,ak->k", away, away), np.finfo(np.float64).tiny)
    return np.maximum(1.0 - along**2 / squared, 0.0), along > 0.0


def _is_nearest(tracks: _Rays, off: Array) -> BoolArray:
    """Whether each ray (r,) is the nearest to its point of those of its image in its track."""
    order = np.lexsort((off, tracks.images, tracks.track))
    first = np.empty(len(order), dtype=bool)
    first[order] = _starts(tracks.track[order], tracks.images[order])
    return first


def _starts(*keys: IntArray) -> BoolArray:
    """Whether each of the sorted keys (r,) differs from the ones before."""
    first = np.ones(len(keys[0]), dtype=bool)
    first[1:] = np.any([np.diff(key) != 0 for key in keys], axis=0)
    return first


def _is_wide(tracks: _Rays, fits: BoolArray, min_angle: float) -> BoolArray:
    """Whether two rays that fit are apart by an angle, and as far from opposite, in each track (t,).

    Two sweeps find them: the ray nearest to a right angle with the first, and that nearest to a right angle with it.
    """
    used = tracks.subset(fits)
    wide = np.zeros(tracks.num_tracks, dtype=bool)
    if not len(used.track):
        return wide
    starts = np.flatnonzero(_starts(used.track))
    place = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(used.track)))
    reference = used.rays[:, starts]
    for _ in range(2):
        cosine = np.abs(np.einsum("ak,ak->k", used.rays, reference[:, place]))
        least = np.minimum.reduceat(cosine, starts)
        farthest = np.flatnonzero(cosine == least[place])
        reference = used.rays[:, farthest[np.searchsorted(farthest, starts)]]
    wide[used.track[starts]] = least <= np.cos(min_angle)
    return wide
