"""Triangulate a reconstruction of poses from the matches of a database, all tracks at once."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.bundle.tracks import MatchedRays
from colmap_vg.bundle.triangulation import triangulate
from colmap_vg.colmap_io.cameras import bearings_of_keypoints
from colmap_vg.colmap_io.model_points import keypoints_of_images, with_points
from colmap_vg.events import StageLog, report_progress
from colmap_vg.mapping.options import MIN_TRIANGULATION_ANGLE_DEG

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _MatchedKeypoints:
    """Keypoints that are matched to others: (k,) image ids and indices, and their rays."""

    image_ids: IntArray
    keypoint_idx: IntArray
    seen: MatchedRays


def with_triangulated_points(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", log: StageLog | None = None
) -> "pycolmap.Reconstruction":
    """Copy a model of poses, and triangulate the points that its registered images have in common.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
        Its matches are used.
    reconstruction : pycolmap.Reconstruction
        With poses, no points.
    log : StageLog, optional
        Told of each image whose rays are computed.

    Returns
    -------
    pycolmap.Reconstruction
    """
    report_progress("tracks")
    matched = _matched_keypoints(cache, reconstruction, log)
    report_progress("points")
    found = triangulate(matched.seen, np.radians(MIN_TRIANGULATION_ANGLE_DEG))
    report_progress("points")
    own = np.flatnonzero(found.point_row >= 0)
    own = own[np.argsort(found.point_row[own], kind="stable")]
    return with_points(
        reconstruction,
        cache,
        found.positions.T,
        found.point_row[own],
        matched.image_ids[own],
        matched.keypoint_idx[own],
    )


def _matched_keypoints(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", log: StageLog | None
) -> _MatchedKeypoints:
    images = [reconstruction.image(image_id) for image_id in sorted(reconstruction.reg_image_ids())]
    pixels = keypoints_of_images(reconstruction)
    first = np.cumsum([0] + [len(pixels[image.image_id]) for image in images])
    matches = _matches(cache, {image.image_id: start for image, start in zip(images, first.tolist(), strict=False)})
    matched = np.zeros(first[-1], dtype=bool)
    matched[matches] = True
    rays, usable = np.empty((3, int(matched.sum()))), np.empty(int(matched.sum()), dtype=bool)
    bounds = np.concatenate([[0], np.cumsum(matched)])[first]
    for row, image in enumerate(images):
        own, at = slice(bounds[row], bounds[row + 1]), slice(first[row], first[row + 1])
        found, usable[own] = bearings_of_keypoints(
            reconstruction.camera(image.camera_id), pixels[image.image_id][matched[at]]
        )
        rays[:, own] = image.cam_from_world().rotation.matrix().T @ found.T
        if log is not None:
            log.progress(f"{row + 1} of {len(images)} images", (row + 1) / len(images), row + 1)
    matches = (np.cumsum(matched) - 1)[matches]
    matches = matches[:, usable[matches].all(axis=0)]
    image_row = np.repeat(np.arange(len(images)), np.diff(bounds))
    centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    return _MatchedKeypoints(
        np.array([image.image_id for image in images], dtype=np.int64)[image_row],
        np.flatnonzero(matched) - first[image_row],
        MatchedRays(image_row, rays, np.ascontiguousarray(centers.T), matches),
    )


def _matches(cache: "pycolmap.DatabaseCache", first: dict[int, int]) -> IntArray:
    """Matched keypoints (2, e) of images whose keypoints are numbered from the given ones on."""
    graph, matches = cache.correspondence_graph, [np.zeros((2, 0), dtype=np.int64)]
    for pair_id in sorted(graph.image_pairs()):
        one, other = pycolmap.pair_id_to_image_pair(pair_id)
        if one in first and other in first:
            found = graph.extract_matches_between_images(one, other)
            matches.append(found.T.astype(np.int64) + np.array([[first[one]], [first[other]]]))
    return np.concatenate(matches, axis=1)
