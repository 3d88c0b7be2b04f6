"""Match and verify a database's features: all pairs of images, or some."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import combinations
from os import PathLike

import numpy as np
import pycolmap

from colmap_vg.events import StageLog
from colmap_vg.features.pair_matching import (
    MAX_FIRST_FEATURES,
    ImageFeatures,
    PairMatches,
    agreement,
    match_all_features,
    match_pair,
)
from colmap_vg.features.pair_selection import strongest
from colmap_vg.features.pairings import SELECTION_SHARE, selected_pairs, sequential_pairs, spatial_pairs
from colmap_vg.linear.threads import num_workers, single_threaded_blas
from colmap_vg.options import FeatureOptions
from colmap_vg.scene.components import components_by_size

MAX_ALL_PAIRS = 20
"""Images; in larger folders ``auto`` selects pairs before it matches them. Smaller ones have hardly a pair to save."""
MIN_VERIFIED_PARTNERS = 5
"""Verified pairs that each image should have; for those with fewer, pairs with few matches are matched in full."""
_FIRST_SHARE = 0.8
"""Share of the time of matching that ends with the largest features, for the progress."""
_PAIRS_PER_BATCH = 16
"""Pairs per thread that are matched between two writes to the database, from where an interrupted job goes on."""
_IMAGES_IN_MEMORY = 256
"""Images whose features are kept between pairs, at 1.2 MB for 8,192 features."""

PairMatcher = Callable[[ImageFeatures, ImageFeatures, pycolmap.TwoViewGeometryOptions], PairMatches]


def match_features(database_path: str | PathLike[str], options: FeatureOptions, log: StageLog) -> int:
    """Match the features of a database's images and verify the pairs; pairs that it already holds are kept.

    Parameters
    ----------
    database_path : path
    options : FeatureOptions
    log : StageLog

    Returns
    -------
    int
        Number of verified pairs in the database.

    Raises
    ------
    ImageFolderError
        Spatial matching is asked for, and the photographs have no GPS positions.
    """
    with log.stage("matching"):
        selected = _match(database_path, options, log)
        with pycolmap.Database.open(database_path) as database:
            num_matched = database.num_matched_image_pairs()
            num_verified = sum(count > 0 for count in database.read_two_view_geometry_num_inliers()[1])
        log.result(f"{num_verified} verified of {num_matched} matched pairs{selected}")
    return int(num_verified)


def _match(database_path: str | PathLike[str], options: FeatureOptions, log: StageLog) -> str:
    """Match pairs as the options say; return what the result says of their selection."""
    if options.matching == "exhaustive":
        _match_exhaustively(database_path, options)
        return ""
    with pycolmap.Database.open(database_path) as database:
        names = sorted(image.name for image in database.read_all_images())
    if options.matching == "sequential":
        match_pairs(database_path, sequential_pairs(names, options.sequential_overlap), options, log)
        return ""
    if options.matching == "auto" and len(names) <= MAX_ALL_PAIRS:
        match_pairs(database_path, list(combinations(names, 2)), options, log)
        return ""
    threads = num_workers(options.num_threads)
    if options.matching == "spatial":
        pairs, apart = spatial_pairs(database_path, log)
        if apart:
            by_features = selected_pairs(database_path, threads, options.random_seed, log)
            pairs += [pair for pair in by_features if not apart.isdisjoint(pair)]
        match_pairs(database_path, pairs, options, log)
        return ""
    match_pairs(database_path, selected_pairs(database_path, threads, options.random_seed, log), options, log)
    return f", selected from {len(names) * (len(names) - 1) // 2}"


def _match_exhaustively(database_path: str | PathLike[str], options: FeatureOptions) -> None:
    """Match all features of all pairs by brute force, with pycolmap."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = options.num_threads
    pairing = pycolmap.ExhaustivePairingOptions()
    pycolmap.match_exhaustive(database_path, matching, pairing, _verification(options), pycolmap.Device.cpu)


def _verification(options: FeatureOptions) -> pycolmap.TwoViewGeometryOptions:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.random_seed
    return verification


@single_threaded_blas
def match_pairs(
    database_path: str | PathLike[str], pairs: Sequence[tuple[str, str]], options: FeatureOptions, log: StageLog
) -> None:
    """Match and verify the given pairs of image names; pairs that the database already holds are kept.

    Pairs that their largest features do not verify are matched in full where an image has few verified pairs, or where
    they would connect images that no verified pairs connect.
    """
    with pycolmap.Database.open(database_path) as database:
        matcher = _Matcher(database, options)
        ids = matcher.image_ids
        by_id = [(ids[first], ids[second]) for first, second in pairs]
        todo = [pair for pair in by_id if not matcher.is_matched(*pair)]
        for done in matcher.match(match_pair, todo):
            share = SELECTION_SHARE + (_FIRST_SHARE - SELECTION_SHARE) * done / len(todo)
            log.progress(f"{done} of {len(todo)} pairs", share, done)
        weak = matcher.weak_pairs(by_id)
        for done in matcher.match(match_all_features, weak):
            share = _FIRST_SHARE + (1.0 - _FIRST_SHARE) * done / len(weak)
            log.progress(f"{done} of {len(weak)} pairs with few matches", share, done)


class _Matcher:
    """Matches pairs of a database's images in threads; reads and writes in one."""

    def __init__(self, database: pycolmap.Database, options: FeatureOptions) -> None:
        self._database, self._verification = database, _verification(options)
        self._workers = num_workers(options.num_threads)
        images = database.read_all_images()
        self.image_ids = {image.name: image.image_id for image in images}
        self._cameras = {image.image_id: database.read_camera(image.camera_id) for image in images}
        self._features = lru_cache(_IMAGES_IN_MEMORY)(self._read_features)

    def _read_features(self, image_id: int) -> ImageFeatures:
        keypoints = self._database.read_keypoints(image_id)
        descriptors = self._database.read_descriptors(image_id).data
        return ImageFeatures(self._cameras[image_id], keypoints, descriptors, strongest(keypoints, MAX_FIRST_FEATURES))

    def is_matched(self, first: int, second: int) -> bool:
        """Whether the database holds the pair, verified or not."""
        database = self._database
        return bool(database.exists_matches(first, second) and database.exists_two_view_geometry(first, second))

    def match(self, how: PairMatcher, pairs: Sequence[tuple[int, int]]) -> Iterator[int]:
        """Match pairs and write what is found; yields how many pairs are done."""
        size = _PAIRS_PER_BATCH * self._workers
        with ThreadPoolExecutor(self._workers) as pool:
            for start in range(0, len(pairs), size):
                yield start
                batch = pairs[start : start + size]
                images = [(self._features(first), self._features(second)) for first, second in batch]
                for pair, found in zip(
                    batch, pool.map(partial(_matched, how, self._verification), images), strict=True
                ):
                    self._write(*pair, found)

    def weak_pairs(self, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Pairs without a verified geometry whose matches agree beyond chance, where images need more pairs."""
        inliers = dict(zip(*self._database.read_two_view_geometry_num_inliers(), strict=True))
        found = [inliers.get(pycolmap.image_pair_to_pair_id(*pair), 0) for pair in pairs]
        verified = np.array(found, dtype=np.int64) > 0
        rows = {image_id: row for row, image_id in enumerate(self._cameras)}
        edges = np.array([(rows[first], rows[second]) for first, second in pairs], dtype=np.int64).reshape(-1, 2)
        partners = np.bincount(edges[verified].ravel(), minlength=len(rows))
        part = components_by_size(len(rows), edges[verified])
        needed = (partners[edges] < MIN_VERIFIED_PARTNERS).any(axis=1) | (part[edges[:, 0]] != part[edges[:, 1]])
        weak = [pairs[row] for row in np.flatnonzero(needed & ~verified).tolist()]
        return [pair for pair in weak if self._agrees(*pair)]

    def _agrees(self, first: int, second: int) -> bool:
        images = self._features(first), self._features(second)
        if not any(image.has_more for image in images):
            return False  # all features are matched already
        matches = np.asarray(self._database.read_matches(first, second), dtype=np.int64).reshape(-1, 2)
        return agreement(*images, matches)[1] > 0.0

    def _write(self, first: int, second: int, found: PairMatches) -> None:
        """Write a pair, in place of what the database holds of it."""
        if self._database.exists_matches(first, second):
            self._database.delete_matches(first, second)
        if self._database.exists_two_view_geometry(first, second):
            self._database.delete_two_view_geometry(first, second)
        self._database.write_matches(first, second, found.matches.astype(np.uint32))
        self._database.write_two_view_geometry(first, second, found.geometry)


def _matched(
    how: PairMatcher, verification: pycolmap.TwoViewGeometryOptions, images: tuple[ImageFeatures, ImageFeatures]
) -> PairMatches:
    return how(*images, verification)
