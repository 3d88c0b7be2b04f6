"""Select the pairs of images to match by preemptive matching, that is, from matches of their largest features only.

Features of the largest scales are few and stable, so pairs that see the same objects have some of them in common
(C. Wu, Towards Linear-Time Incremental Structure from Motion, 3DV 2013, section 3). Matches by chance are recognised by
weak geometric consistency (Jégou, Douze and Schmid, ECCV 2008): correct matches of a pair agree on the rotation and the
change of scale between the images, wrong ones do not.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree

from colmap_vg.features.nearest_descriptors import mutual_matches
from colmap_vg.features.orientation_votes import excess_over_chance, log2_scales, num_agreeing, orientations
from colmap_vg.features.shortlist import shared_partners
from colmap_vg.linear.threads import single_threaded_blas

STRONGEST_SHARE = 8
"""One in this many of the median image's features is matched preemptively."""
STRONGEST_LIMITS = (300, 1000)
"""Minimum and maximum number of features per image that are matched preemptively."""
_KEPT = 0.99
"""Share of the sum of all pair scores to reach; in five scenes the selected pairs had 97 to 99.9 % of the inlier
matches."""
MIN_PARTNERS = 8
"""Minimum number of images with which each image is matched, whatever the pair scores."""
MAX_PARTNERS = 110
"""Number of images beyond which more add time and hardly accuracy: without it the pairs of a folder in which all see
the same grow with the square of their number."""

IntArray = NDArray[np.int64]
CountArray = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class StrongestFeatures:
    """The features of largest scale of n images, at most h per image.

    Attributes
    ----------
    descriptors : (n, h, d) uint8 array
        Norms are near 512; rows are zero where an image has fewer features.
    log2_scales : (n, h) array
        Binary logarithms of the features' sizes in pixels.
    orientations : (n, h) array
        Radians.
    """

    descriptors: NDArray[np.uint8]
    log2_scales: NDArray[np.float64]
    orientations: NDArray[np.float64]


def num_strongest(num_features: Sequence[int]) -> int:
    """Number of features per image to match preemptively, from the numbers of features of all images."""
    typical = int(np.median(num_features)) if len(num_features) else 0
    return int(np.clip(typical // STRONGEST_SHARE, *STRONGEST_LIMITS))


def strongest(keypoints: NDArray[np.float32], most: int) -> IntArray:
    """Rows of the keypoints of largest scale in descending order, ties in the order of the rows.

    Parameters
    ----------
    keypoints : (k, 6) array
        x, y and the affine shape a11, a12, a21, a22, as in COLMAP's databases, pixels.
    most : int
        Maximum number of rows.
    """
    return np.argsort(-log2_scales(keypoints), kind="stable")[:most]


def strongest_features(keypoints: list[NDArray[np.float32]], descriptors: list[NDArray[np.uint8]]) -> StrongestFeatures:
    """Collect keypoints (k, 6) and descriptors (k, d) of each image in arrays over all images."""
    most = max((len(own) for own in keypoints), default=0)
    width = max((own.shape[1] for own in descriptors), default=0)
    block = np.zeros((len(keypoints), most, width), np.uint8)
    scales, turns = np.zeros(block.shape[:2]), np.zeros(block.shape[:2])
    for image, (points, bytes_) in enumerate(zip(keypoints, descriptors, strict=True)):
        block[image, : len(points), : bytes_.shape[1]] = bytes_
        scales[image, : len(points)] = log2_scales(points)
        turns[image, : len(points)] = orientations(points)
    return StrongestFeatures(block, scales, turns)


@single_threaded_blas
def preemptive_matches(
    features: StrongestFeatures,
    num_threads: int,
    on_progress: Callable[[float], None] = lambda _: None,
    candidates: NDArray[np.bool_] | None = None,
) -> tuple[CountArray, CountArray]:
    """Match the strongest features of pairs of images.

    Parameters
    ----------
    features : StrongestFeatures
    num_threads : int
        Number of threads, each with one BLAS thread; the result does not depend on it.
    on_progress : callable, optional
        Called with the share of pairs that are done.
    candidates : (n, n) bool array, optional
        Pairs to match; symmetric. Missing: all pairs.

    Returns
    -------
    num_matches : (n, n) int32 array
        Mutually nearest features that pass the ratio test; symmetric, 0 for other pairs.
    num_consistent : (n, n) int32 array
        The largest number of them that agree on a rotation within 60 degrees and a change of scale within two octaves;
        symmetric.
    """
    n = len(features.descriptors)
    candidates = ~np.eye(n, dtype=bool) if candidates is None else candidates
    matches, consistent = np.zeros((n, n), np.int32), np.zeros((n, n), np.int32)

    def match_with_later(first: int) -> None:
        for second in (first + 1 + np.flatnonzero(candidates[first, first + 1 :])).tolist():
            rows, columns = mutual_matches(features.descriptors[first], features.descriptors[second]).T
            matches[first, second] = matches[second, first] = len(rows)
            consistent[first, second] = consistent[second, first] = num_agreeing(
                features.orientations[first, rows] - features.orientations[second, columns],
                features.log2_scales[first, rows] - features.log2_scales[second, columns],
            )

    with ThreadPoolExecutor(num_threads) as pool:
        done = 0
        for first, _ in enumerate(pool.map(match_with_later, range(n))):
            done += int(candidates[first, first + 1 :].sum())
            on_progress(2.0 * done / max(int(candidates.sum()), 1))
    return matches, consistent


def pair_scores(num_matches: CountArray, num_consistent: CountArray) -> NDArray[np.float64]:
    """Score each pair of images by the number of consistent matches of its strongest features beyond chance.

    A pair's own score is the number of consistent matches above the expected number by chance plus two standard
    deviations. A second part, with the same sum over all pairs, comes from third images: two images that both match
    the same others are likely to overlap, too.

    Parameters
    ----------
    num_matches, num_consistent : (n, n) int32 arrays
        From :func:`preemptive_matches`.

    Returns
    -------
    (n, n) array
        Scores, in matches; symmetric.
    """
    excess = excess_over_chance(num_consistent, num_matches)
    through_others = shared_partners(excess)
    if through_others.any():
        excess = excess + through_others * (excess.sum() / through_others.sum())
    return np.asarray(np.round(excess, 6))  # so that the order does not depend on the last bit of a product


@single_threaded_blas
def select_pairs(
    num_matches: CountArray,
    num_consistent: CountArray,
    min_partners: int = MIN_PARTNERS,
    max_partners: int = MAX_PARTNERS,
) -> IntArray:
    """Select the pairs of images to match with all features.

    These are the pairs with the highest scores, up to nearly the sum of all scores; the best partners of each image;
    and the best pairs that connect all images. Among equal scores, pairs of images that are close in order come first.

    Parameters
    ----------
    num_matches, num_consistent : (n, n) int32 arrays
        From :func:`preemptive_matches`.
    min_partners : int
        Minimum number of pairs of each image.
    max_partners : int
        Pairs that are among so many best of neither image are left out.

    Returns
    -------
    (m, 2) int64 array
        Rows of images, ``first < second``, in lexicographic order.
    """
    n = len(num_matches)
    if n < 2:
        return np.empty((0, 2), np.int64)
    first, second = np.triu_indices(n, 1)
    scores = pair_scores(num_matches, num_consistent)[first, second]
    order = np.lexsort((second - first, -num_matches[first, second], -num_consistent[first, second], -scores))
    rank = np.empty(len(first), np.int64)
    rank[order] = np.arange(1, len(first) + 1)
    ranks = np.zeros((n, n), np.int64)
    ranks[first, second] = rank
    before = np.concatenate([[0.0], np.cumsum(scores[order])])[:-1]
    chosen = np.zeros((n, n), dtype=bool)
    chosen[first[order], second[order]] = before < _KEPT * scores.sum()
    chosen[minimum_spanning_tree(ranks).nonzero()] = True
    chosen |= chosen.T
    ranks += ranks.T
    np.fill_diagonal(ranks, len(first) + 1)
    limit = np.sort(ranks, axis=1)[:, min(min_partners, n - 1) - 1]
    chosen |= ranks <= np.maximum(limit[:, None], limit[None, :])
    limit = np.sort(ranks, axis=1)[:, min(max_partners, n - 1) - 1]
    chosen &= ranks <= np.maximum(limit[:, None], limit[None, :])
    np.fill_diagonal(chosen, False)
    return np.argwhere(np.triu(chosen)).astype(np.int64)
