"""Tracks of matched keypoints with known poses; matches whose depth contradicts the others of a keypoint are dropped.

A match tells how far along each of its two rays they meet. With rays u1, u2 and the vector b between the centres, the
inverse depth along u1 is ``w = (1 - (u1 u2)^2) / (b u1 - (u1 u2)(b u2))``, and a change of it by dw is an angle of
``dw |b x u2|`` between the rays. Where most matches of a keypoint are right, so is their median.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_ANGLE = np.radians(2.0)
"""Maximum angle between a keypoint's ray and its point, as in COLMAP: bundle adjustment decides with a narrower one."""
BLOCK = 1 << 17
"""Matches whose depths are computed at once; memory grows with it, time does not."""


@dataclass(frozen=True, eq=False)
class MatchedRays:
    """Keypoints that are matched to others, with their rays.

    Attributes
    ----------
    image_row : (k,) int64 array
        Image of each keypoint.
    rays : (3, k) array
        Unit vectors, world frame.
    centers : (3, n) array
        Projection centres of the images, world frame.
    matches : (2, e) int64 array
        Rows of matched keypoints, of two images.
    """

    image_row: IntArray
    rays: Array
    centers: Array
    matches: IntArray


def consistent_matches(seen: MatchedRays) -> BoolArray:
    """Matches (e,) whose inverse depths are within `MAX_ANGLE` of the weighted medians of both keypoints."""
    k, e = len(seen.image_row), seen.matches.shape[1]
    inverse, lever = np.empty((2, e), dtype=np.float32), np.empty((2, e), dtype=np.float32)
    for start in range(0, e, BLOCK):
        own = slice(start, start + BLOCK)
        inverse[:, own], lever[:, own] = _inverse_depths(seen, seen.matches[:, own])
    medians = np.nan_to_num(_weighted_medians(seen.matches.ravel(), inverse.ravel(), lever.ravel(), k))
    consistent = np.ones(e, dtype=bool)
    for side, at in enumerate(seen.matches):
        with np.errstate(invalid="ignore"):
            consistent &= np.abs(inverse[side] - medians[at]) * lever[side] <= MAX_ANGLE
    return consistent


def _inverse_depths(seen: MatchedRays, matches: IntArray) -> tuple[Array, Array]:
    """Inverse depths (2, e) along both rays where they are nearest to each other, and levers of these (2, e)."""
    first, second = np.take(seen.rays, matches[0], axis=1), np.take(seen.rays, matches[1], axis=1)
    between = np.diff(np.take(seen.centers, seen.image_row[matches], axis=1), axis=1)[:, 0]
    cosine = np.einsum("ae,ae->e", first, second)
    along1, along2 = np.einsum("ae,ae->e", between, first), np.einsum("ae,ae->e", between, second)
    squared = np.einsum("ae,ae->e", between, between)
    sine = np.maximum(1.0 - cosine**2, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = sine / np.stack([along1 - cosine * along2, cosine * along1 - along2])
    # Parallel rays meet nowhere, and rays from one place tell no depth.
    inverse[:, (sine == 0.0) | (squared == 0.0)] = 0.0
    levers = np.sqrt(np.maximum(squared - np.square([along2, along1]), 0.0))
    return inverse, levers


def _weighted_medians(segment: IntArray, values: NDArray[np.float32], weights: NDArray[np.float32], n: int) -> Array:
    """Weighted medians (n,) of the values (k,) of each segment (k,); NaN where there are none."""
    finite = np.isfinite(values)
    spread = float(np.median(np.abs(values[finite]))) if finite.any() else 1.0
    # One sort by segment and value: values between zero and one, in their order, are added to whole numbers.
    with np.errstate(over="ignore"):
        ranked = 0.5 + np.arctan(np.nan_to_num(values, nan=np.inf) / (spread or 1.0)) / (np.pi * (1.0 + 1e-6))
    order = np.argsort(segment + ranked.astype(np.float64))
    total = np.concatenate([[0.0], np.cumsum(np.where(finite, weights, 0.0)[order], dtype=np.float64)])
    ends = np.cumsum(np.bincount(segment, minlength=n))
    below, above = total[np.concatenate([[0], ends[:-1]])], total[ends]
    place = np.searchsorted(total[1:], 0.5 * (below + above))
    found = values[order[np.minimum(place, len(order) - 1)]].astype(np.float64) if len(order) else np.zeros(n)
    return np.where(above > below, found, np.nan)


def connected_tracks(matches: IntArray, num_keypoints: int) -> IntArray:
    """Track of each keypoint (k,), a connected component of matches (2, e); -1 without a match."""
    matched = np.zeros(num_keypoints, dtype=bool)
    matched[matches] = True
    rows = np.cumsum(matched, dtype=np.int32) - 1
    links = (np.ones(matches.shape[1], dtype=bool), (rows[matches[0]], rows[matches[1]]))
    count = int(matched.sum())
    tracks = np.full(num_keypoints, -1)
    tracks[matched] = connected_components(sp.coo_array(links, shape=(count, count)), directed=False)[1]
    return tracks
