"""Which pairs of images to match: selected by their features, neighbours in a sequence, or neighbours by GPS."""

import re
from collections.abc import Sequence
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.pose_priors import read_pose_priors
from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageLog
from colmap_vg.features.orientation_votes import excess_over_chance
from colmap_vg.features.pair_selection import (
    num_strongest,
    preemptive_matches,
    select_pairs,
    strongest,
    strongest_features,
)
from colmap_vg.features.photographs import MIN_IMAGES
from colmap_vg.features.shortlist import partners_of_partners, shortlisted

MAX_DISTANCE = 100.0
"""Metres between the GPS positions of photographs that spatial matching pairs."""
MAX_SPATIAL_NEIGHBORS = 50
"""Photographs with which spatial matching pairs each, the nearest ones; as in COLMAP."""
MORE_CANDIDATES = 50
"""Images with which each is first matched after the shortlist, for the partners that they share."""
SELECTION_SHARE = 0.05
"""Share of the time of matching that selecting pairs takes, for the progress."""

NamePairs = list[tuple[str, str]]


def selected_pairs(database_path: str | PathLike[str], num_threads: int, seed: int, log: StageLog) -> NamePairs:
    """Select the pairs of a database's images to match, by their strongest features.

    Parameters
    ----------
    database_path : path
    num_threads : int
    seed : int
        Of the words by which images of large folders are compared.
    log : StageLog

    Returns
    -------
    list of (str, str)
        Names of images.
    """

    def progress(done: float) -> None:
        log.progress("selecting pairs", SELECTION_SHARE * done)

    with pycolmap.Database.open(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: _natural(image.name))
        most = num_strongest([database.num_keypoints_for_image(image.image_id) for image in images])
        keypoints, descriptors = [], []
        for image in images:
            own = database.read_keypoints(image.image_id)
            rows = strongest(own, most)
            keypoints.append(own[rows])
            descriptors.append(database.read_descriptors(image.image_id).data[rows])
    features = strongest_features(keypoints, descriptors)
    names, located = [image.name for image in images], _gps_positions(database_path)
    positions = np.array([located.get(name, np.full(3, np.nan)) for name in names])
    candidates = shortlisted(features.descriptors, positions, seed)
    num_matches, num_consistent = preemptive_matches(features, num_threads, progress, candidates)
    more = partners_of_partners(excess_over_chance(num_consistent, num_matches), candidates, MORE_CANDIDATES)
    if more.any():
        added = preemptive_matches(features, num_threads, candidates=more)
        num_matches, num_consistent = num_matches + added[0], num_consistent + added[1]
    return [(names[first], names[second]) for first, second in select_pairs(num_matches, num_consistent)]


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


def spatial_pairs(database_path: str | PathLike[str], log: StageLog) -> tuple[NamePairs, set[str]]:
    """Pair photographs with their nearest neighbours by GPS position.

    Parameters
    ----------
    database_path : path
    log : StageLog
        Receives a warning that names the photographs without neighbours.

    Returns
    -------
    pairs : list of (str, str)
        Pairs of at most 100 m, and of each photograph its 50 nearest.
    without_neighbors : set of str
        Photographs without a position, or farther than that from all others.

    Raises
    ------
    ImageFolderError
        Fewer than three photographs have a position.
    """
    with pycolmap.Database.open(database_path) as database:
        every = [image.name for image in database.read_all_images()]
    located = _gps_positions(database_path)
    if len(located) < MIN_IMAGES:
        raise ImageFolderError(
            f"{len(located)} of {len(every)} photographs have a GPS position; spatial matching needs them:"
            " use matching='auto'"
        )
    names, positions = [*located], np.array([*located.values()])
    lacking = [name for name in every if name not in located]
    neighbors = min(MAX_SPATIAL_NEIGHBORS + 1, len(names))
    from scipy.spatial import cKDTree  # takes 0.1 s to import, in vain without positions

    distances, nearest = cKDTree(positions).query(positions, neighbors)
    near = (distances <= MAX_DISTANCE) & (nearest != np.arange(len(names))[:, None])
    rows = np.stack([np.nonzero(near)[0], nearest[near]], axis=1)
    rows = np.unique(np.sort(rows, axis=1), axis=0)
    far = [name for name, has_neighbor in zip(names, near.any(axis=1), strict=True) if not has_neighbor]
    for apart, why in (
        (lacking, "have no GPS position"),
        (far, f"are more than {MAX_DISTANCE:.0f} m away from all others"),
    ):
        if apart:
            log.warn(f"{len(apart)} photographs {why}, and are matched by their features: {', '.join(sorted(apart))}")
    return [(names[first], names[second]) for first, second in rows.tolist()], {*far, *lacking}


def _gps_positions(database_path: str | PathLike[str]) -> dict[str, NDArray[np.float64]]:
    """Positions (3,) of the images that have one, metres; those by GPS without their heights, which are poor."""
    with pycolmap.Database.open(database_path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
    priors, _ = read_pose_priors(database_path, list(names))
    if priors is None:
        return {}
    positions = priors.positions if priors.origin is None else priors.positions * np.array([1.0, 1.0, 0.0])
    return {name: at for name, at in zip(names.values(), positions, strict=True) if np.isfinite(at).all()}
