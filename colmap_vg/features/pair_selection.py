"""Which pairs of images are worth matching, by a first look at their largest features alone.

Wu, "Towards Linear-Time Incremental Structure from Motion" (3DV 2013), §3.1: the features of largest scale survive
changes of view, and few of them tell whether two images overlap. Here a pair's mutual best matches among them vote with
their turn and change of scale, which matches of the same surface share and chance matches do not: at one turn and scale
in common, eight votes are few for a pair that overlaps and many for one that does not.
"""

import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.threads import single_threaded_blas

Array = NDArray[np.float32]
IntArray = NDArray[np.int64]

FEATURES_PER_IMAGE = 400
MAX_ANGLE, MAX_RATIO = 0.8, 0.85
"""Radians between matched descriptors, and over the angle to the second best: looser than in matching."""
TURN_BINS, SCALE_BINS, SCALE_STEP = 24, 13, 0.5
"""Of the votes' histogram; steps of scale are natural logarithms. Two bins by two count together."""
MIN_VOTES = 8
PARTNERS_PER_IMAGE = 12
"""Each image is matched with so many at least, those of most votes."""
IMAGES_PER_BLOCK = 16


@dataclass(frozen=True, eq=False)
class LargestFeatures:
    """The features of largest scale of n images; missing ones are zero.

    Attributes
    ----------
    image_ids : (n,) int64 array
    descriptors : (n, k, 128) float32 array
        Unit length.
    turns : (n, k) float32 array
        Orientations, radians.
    log_scales : (n, k) float32 array
    """

    image_ids: IntArray
    descriptors: Array
    turns: Array
    log_scales: Array


def promising_pairs(
    features: LargestFeatures, num_threads: int, *, min_votes: int = MIN_VOTES, partners: int = PARTNERS_PER_IMAGE
) -> IntArray:
    """Pairs of images whose largest features agree, and the best partners of each image.

    Parameters
    ----------
    features : LargestFeatures
    num_threads : int
        The result does not depend on it.
    min_votes : int
    partners : int

    Returns
    -------
    (m, 2) int64 array
        Image ids, the first below the second, in rising order.
    """
    votes = all_votes(features, num_threads)
    n = len(votes)
    kept = votes >= min_votes
    # Ties go to the nearest names: photographs that follow each other overlap more often than not.
    nearness = np.abs(np.arange(n)[:, None] - np.arange(n))
    order = np.lexsort((nearness, -votes), axis=1)
    best = order[:, :partners]
    chosen = np.zeros_like(kept)
    np.put_along_axis(chosen, best, True, axis=1)
    kept |= chosen | chosen.T
    first, second = np.nonzero(np.triu(kept, 1))
    pairs = np.stack([features.image_ids[first], features.image_ids[second]], axis=1)
    return np.asarray(np.sort(pairs, axis=1)[np.lexsort((pairs.max(axis=1), pairs.min(axis=1)))], dtype=np.int64)


@single_threaded_blas
def all_votes(features: LargestFeatures, num_threads: int) -> IntArray:
    """Votes for the turn and scale that most matches of each pair share: (n, n), symmetric; -1 on the diagonal."""
    n = len(features.image_ids)
    votes = np.full((n, n), -1, dtype=np.int64)

    def row(image: int) -> None:
        for start in range(image + 1, n, IMAGES_PER_BLOCK):
            others = slice(start, min(start + IMAGES_PER_BLOCK, n))
            votes[image, others] = _votes(features, image, others)

    with ThreadPoolExecutor(num_threads) as pool:
        list(pool.map(row, range(n)))
    return np.maximum(votes, votes.T)


def _votes(features: LargestFeatures, image: int, others: slice) -> IntArray:
    own, theirs = features.descriptors[image], features.descriptors[others]
    count, k, _ = theirs.shape
    similarity = (own @ theirs.reshape(count * k, -1).T).reshape(k, count, k)
    best = similarity.argmax(axis=2)  # (k, count)
    mutual = np.take_along_axis(similarity.argmax(axis=0).T, best, axis=0) == np.arange(k)[:, None]
    first = np.take_along_axis(similarity, best[:, :, None], axis=2)
    np.put_along_axis(similarity, best[:, :, None], -1.0, axis=2)
    angle, second = (np.arccos(np.clip(s, -1.0, 1.0)) for s in (first[:, :, 0], similarity.max(axis=2)))
    good = mutual & (angle < MAX_ANGLE) & (angle < MAX_RATIO * second)
    mine, pair = np.nonzero(good)
    other = best[good]
    turn = np.mod(features.turns[others][pair, other] - features.turns[image, mine], 2.0 * np.pi)
    scale = features.log_scales[others][pair, other] - features.log_scales[image, mine]
    turn_bin = np.minimum((turn * (TURN_BINS / (2.0 * np.pi))).astype(np.int64), TURN_BINS - 1)
    scale_bin = np.clip(np.round(scale / SCALE_STEP) + SCALE_BINS // 2, 0, SCALE_BINS - 1).astype(np.int64)
    cell = (pair * TURN_BINS + turn_bin) * SCALE_BINS + scale_bin
    table = np.bincount(cell, minlength=count * TURN_BINS * SCALE_BINS).reshape(count, TURN_BINS, SCALE_BINS)
    table = table + np.roll(table, -1, axis=1)
    return np.asarray((table[:, :, :-1] + table[:, :, 1:]).max(axis=(1, 2)), dtype=np.int64)


def largest_features(database_path: Path, num_features: int = FEATURES_PER_IMAGE) -> LargestFeatures:
    """Read the features of largest scale of all images of a database that COLMAP's extraction wrote.

    Parameters
    ----------
    database_path : Path
    num_features : int
        Of each image.
    """
    rows = list(_features(database_path))
    n = len(rows)
    descriptors = np.zeros((n, num_features, 128), dtype=np.float32)
    turns, log_scales = np.zeros((2, n, num_features), dtype=np.float32)
    for place, (_, shapes, values) in enumerate(rows):
        scale = np.sqrt(np.abs(np.linalg.det(shapes)))
        largest = np.argsort(-scale, kind="stable")[:num_features]
        own = values[largest].astype(np.float32)
        descriptors[place, : len(own)] = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-9)
        turns[place, : len(own)] = np.arctan2(shapes[largest, 1, 0], shapes[largest, 0, 0])
        log_scales[place, : len(own)] = np.log(np.maximum(scale[largest], 1e-6))
    return LargestFeatures(np.array([row[0] for row in rows], dtype=np.int64), descriptors, turns, log_scales)


def _features(database_path: Path) -> Iterator[tuple[int, Array, NDArray[np.uint8]]]:
    """Image id, shapes (k, 2, 2) of its keypoints, and descriptors (k, 128), by the images' names."""
    statement = (
        "SELECT images.image_id, keypoints.rows, keypoints.cols, keypoints.data, descriptors.data FROM images"
        " JOIN keypoints ON keypoints.image_id = images.image_id"
        " JOIN descriptors ON descriptors.image_id = images.image_id"
        " WHERE keypoints.rows > 0 ORDER BY images.name"
    )
    with closing(sqlite3.connect(f"{database_path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
        for image_id, rows, cols, keypoints, descriptors in connection.execute(statement):
            own = np.frombuffer(keypoints, dtype=np.float32).reshape(rows, cols)
            shapes = own[:, 2:6].reshape(rows, 2, 2)
            yield image_id, shapes, np.frombuffer(descriptors, dtype=np.uint8).reshape(rows, 128)
