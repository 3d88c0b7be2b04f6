"""Matches of a database's features: of all pairs, of pairs chosen beforehand, of neighbours in time or in space."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageLog
from colmap_vg.features.pair_selection import (
    num_strongest,
    preemptive_matches,
    select_pairs,
    strongest,
    strongest_features,
)
from colmap_vg.features.photographs import MIN_IMAGES
from colmap_vg.options import FeatureOptions

MAX_EXHAUSTIVE = 20
"""Images; in larger folders ``auto`` chooses pairs before it matches them. Smaller ones have hardly a pair to save."""
MAX_DISTANCE = 100.0
"""Metres between the GPS positions of photographs that spatial matching pairs."""
_PAIRS_PER_CALL = 2000
"""Pairs per thread and call of pycolmap: progress is told between calls, and each call indexes its images anew."""
_SELECTING = 0.05
"""Share of the stage's time that choosing takes, for the progress."""
_MARK = "colmap_vg-listed:"
"""Begins names that cannot stand in a list of pairs, while one is matched."""


def match_features(database_path: str | PathLike[str], options: FeatureOptions, log: StageLog) -> int:
    """Match the features of a database's images and verify the pairs; pairs that it already holds are kept.

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
        restore_names(database_path)
        chosen = _match(database_path, options, log)
        with pycolmap.Database.open(database_path) as database:
            num_matched = database.num_matched_image_pairs()
            num_verified = sum(count > 0 for count in database.read_two_view_geometry_num_inliers()[1])
        log.result(f"{num_verified} verified of {num_matched} matched pairs{chosen}")
    return int(num_verified)


def _match(database_path: str | PathLike[str], options: FeatureOptions, log: StageLog) -> str:
    """Match; what there is to say of the choice of pairs."""
    matching, verification, device = *_matching_options(options), pycolmap.Device.cpu
    if options.matching == "sequential":
        with pycolmap.Database.open(database_path) as database:
            names = [image.name for image in database.read_all_images()]
        match_pairs(database_path, sequential_pairs(names, options.sequential_overlap), options, log)
        return ""
    if options.matching == "spatial":
        apart = _without_neighbours(database_path, log)
        spatial = pycolmap.SpatialPairingOptions()
        spatial.num_threads, spatial.max_distance = options.num_threads, MAX_DISTANCE
        pycolmap.match_spatial(database_path, matching, spatial, verification, device)
        if apart:
            pairs = promising_pairs(database_path, options.num_threads, log)
            match_pairs(database_path, [pair for pair in pairs if not apart.isdisjoint(pair)], options, log)
        return ""
    with pycolmap.Database.open(database_path) as database:
        num_images = database.num_images()
    if options.matching == "exhaustive" or (options.matching == "auto" and num_images <= MAX_EXHAUSTIVE):
        pairing = pycolmap.ExhaustivePairingOptions()
        pycolmap.match_exhaustive(database_path, matching, pairing, verification, device)
        return ""
    pairs = promising_pairs(database_path, options.num_threads, log)
    match_pairs(database_path, pairs, options, log)
    return f", chosen from {num_images * (num_images - 1) // 2}"


def _matching_options(
    options: FeatureOptions,
) -> tuple[pycolmap.FeatureMatchingOptions, pycolmap.TwoViewGeometryOptions]:
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = options.num_threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.random_seed
    return matching, verification


def _without_neighbours(database_path: str | PathLike[str], log: StageLog) -> set[str]:
    """Names of images that have no other near by GPS positions: named, and to be matched by their features.

    Raises
    ------
    ImageFolderError
        Fewer than three images have a position.
    """
    with pycolmap.Database.open(database_path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        priors = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
    located = {image_id: prior for image_id, prior in priors.items() if image_id in names and _is_told(prior.position)}
    if len(located) < MIN_IMAGES:
        raise ImageFolderError(
            f"{len(located)} of {len(names)} photographs have a GPS position; spatial matching needs them:"
            " use matching='auto'"
        )
    positions = np.array([prior.position for prior in located.values()])
    if all(prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84 for prior in located.values()):
        positions[:, 2] = 0.0
        positions = pycolmap.GPSTransform().ellipsoid_to_ecef(positions)
    nearest = cKDTree(positions).query(positions, 2)[0][:, 1]
    far = [names[image_id] for image_id, away in zip(located, nearest, strict=True) if away > MAX_DISTANCE]
    lacking = [name for image_id, name in names.items() if image_id not in located]
    for apart, why in (
        (lacking, "have no GPS position"),
        (far, f"are more than {MAX_DISTANCE:.0f} m away from all others"),
    ):
        if apart:
            log.warn(f"{len(apart)} photographs {why}, and are matched by their features: {', '.join(sorted(apart))}")
    return {*far, *lacking}


def _is_told(position: NDArray[np.float64]) -> bool:
    """Whether a GPS position is one: receivers without a fix write zeros, in the Gulf of Guinea."""
    return bool(np.all(np.isfinite(position)) and np.any(position[:2] != 0.0))


def promising_pairs(database_path: str | PathLike[str], num_threads: int, log: StageLog) -> list[tuple[str, str]]:
    """Names of the pairs of a database's images that are worth matching, from their strongest features."""
    with pycolmap.Database.open(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        most = num_strongest([database.num_keypoints_for_image(image.image_id) for image in images])
        keypoints, descriptors = [], []
        for image in images:
            own = database.read_keypoints(image.image_id)
            rows = strongest(own, most)
            keypoints.append(own[rows])
            descriptors.append(database.read_descriptors(image.image_id).data[rows])
    features = strongest_features(keypoints, descriptors)
    counts = preemptive_matches(
        features, _num_threads(num_threads), lambda done: log.progress("choosing pairs", _SELECTING * done)
    )
    return [(images[first].name, images[second].name) for first, second in select_pairs(*counts)]


def sequential_pairs(names: Sequence[str], overlap: int) -> list[tuple[str, str]]:
    """Pairs of each image with those that follow it, and with others at growing distances.

    Parameters
    ----------
    names : sequence of str
        In any order. Numbers in them count as numbers: frame2 comes before frame10.
    overlap : int
        Images that follow, and powers of two from 1 on at whose distances others are taken.

    Returns
    -------
    list of (str, str)
    """
    ordered = sorted(names, key=_natural)
    distances = sorted({*range(1, overlap + 1), *(2**power for power in range(overlap) if 2**power < len(ordered))})
    return [
        (name, ordered[place + distance])
        for place, name in enumerate(ordered)
        for distance in distances
        if place + distance < len(ordered)
    ]


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Key by which runs of digits sort as numbers, before letters; equal numbers by the name as it is."""
    parts = [part for part in re.split(r"([0-9]+)", name) if part]
    return [(0, int(part), "") if part.isdecimal() and part.isascii() else (1, 0, part) for part in parts], name


def match_pairs(
    database_path: str | PathLike[str], pairs: Sequence[tuple[str, str]], options: FeatureOptions, log: StageLog
) -> None:
    """Match and verify the given pairs of names; those that the database already holds are kept."""
    matching, verification = _matching_options(options)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = Path(f"{os.fspath(database_path)}-pairs.txt")
    step = _PAIRS_PER_CALL * _num_threads(options.num_threads)
    with _names_for_lists(database_path) as listed:
        try:
            for start in range(0, len(pairs), step):
                share = _SELECTING + (1.0 - _SELECTING) * start / len(pairs)
                log.progress(f"{start} of {len(pairs)} pairs", share)
                lines = [f"{listed[first]} {listed[second]}\n" for first, second in pairs[start : start + step]]
                pairing.match_list_path.write_text("".join(lines), encoding="utf-8")
                pycolmap.match_image_pairs(database_path, matching, pairing, verification, pycolmap.Device.cpu)
        finally:
            pairing.match_list_path.unlink(missing_ok=True)


@contextmanager
def _names_for_lists(database_path: str | PathLike[str]) -> Iterator[dict[str, str]]:
    """Names of images as a list of pairs may hold them; COLMAP ends a name at a blank, without a word.

    Those that may not are another for as long, in a form from which :func:`restore_names` brings them back.
    """
    with pycolmap.Database.open(database_path) as database:
        images = database.read_all_images()
        listed = {image.name: _listed(image.name) for image in images}
        for image in images:
            if listed[image.name] != image.name:
                image.name = listed[image.name]
                database.update_image(image)
    try:
        yield listed
    finally:
        restore_names(database_path)


def _listed(name: str) -> str:
    fits = name.isprintable() and not any(letter.isspace() for letter in name) and not name.startswith(("#", _MARK))
    return name if fits else _MARK + quote(name)


def restore_names(database_path: str | PathLike[str]) -> None:
    """Give images their names back that a job killed while it matched a list of pairs left behind under others."""
    with pycolmap.Database.open(database_path) as database:
        for image in database.read_all_images():
            if image.name.startswith(_MARK):
                image.name = unquote(image.name.removeprefix(_MARK))
                database.update_image(image)


def _num_threads(num_threads: int) -> int:
    return num_threads if num_threads > 0 else os.cpu_count() or 1
