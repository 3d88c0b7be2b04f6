"""Visibility of a model's points: which images observe them, and into which images they project."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.model_observations import ModelObservations

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_NUM_POINTS = 3000
"""Maximum number of sampled points, drawn evenly over track lengths."""
MIN_TRACK_LENGTH = 3
"""Minimum number of images that see a sampled point."""
NEAR_DEG = 15.0
"""Degrees; an image should see a point in its frame if another image sees it, and their rays at the point meet at no
more than this angle."""


@dataclass(frozen=True, eq=False)
class SampledTracks:
    """A sample of the points that three images or more see.

    Attributes
    ----------
    every : (q, 3) array
        All points of the model, world frame.
    points : (k, 3) array
        The sample.
    sees : (k, n) bool array
        Whether each image sees each point.
    num_observations : int
        Number of observations of all such points, sampled or not.
    """

    every: Array
    points: Array
    sees: BoolArray
    num_observations: int


def sampled_tracks(
    reconstruction: "pycolmap.Reconstruction", image_ids: list[int], max_num_points: int = MAX_NUM_POINTS
) -> SampledTracks:
    """Sample a model's points evenly over their track lengths.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    image_ids : list of int
        All registered images; the columns of the result.
    max_num_points : int
    """
    n = len(image_ids)
    # Each image once, even if it sees a point at two keypoints.
    seen = ModelObservations.of(reconstruction)
    image_row = np.searchsorted(image_ids, seen.image_ids)
    sights = np.sort(seen.point_ids * n + image_row)
    observed, image_row = np.divmod(sights[np.diff(sights, prepend=-1) > 0], n)
    point_ids, point_row, length = np.unique(observed, return_inverse=True, return_counts=True)
    by_length = np.argsort(length, kind="stable")
    by_length = by_length[length[by_length] >= MIN_TRACK_LENGTH]
    if not len(by_length):
        return SampledTracks(seen.positions, np.zeros((0, 3)), np.zeros((0, n), dtype=bool), 0)
    sampled = by_length[np.unique(np.linspace(0, len(by_length) - 1, max_num_points).astype(int))]
    row_of = np.full(len(point_ids), -1)
    row_of[sampled] = np.arange(len(sampled))
    counted = row_of[point_row] >= 0
    sees = np.zeros((len(sampled), n), dtype=bool)
    sees[row_of[point_row[counted]], image_row[counted]] = True
    positions = seen.positions_of(point_ids[sampled])
    return SampledTracks(seen.positions, positions, sees, int(length[by_length].sum()))


def in_frame(reconstruction: "pycolmap.Reconstruction", image_ids: list[int], xyz: Array) -> BoolArray:
    """Whether each of the points (k, 3), world frame, projects into each image, (k, n)."""
    inside = np.zeros((len(xyz), len(image_ids)), dtype=bool)
    for column, image_id in enumerate(image_ids):
        image = reconstruction.image(image_id)
        camera = reconstruction.camera(image.camera_id)
        local = image.cam_from_world() * xyz
        front = np.flatnonzero((local[:, 2] > 0) | camera.is_spherical())
        pixels = np.asarray(camera.img_from_cam(local[front]), dtype=np.float64).reshape(-1, 2)
        size = np.array([camera.width, camera.height])
        inside[front, column] = ((pixels >= 0) & (pixels < size)).all(axis=1)
    return inside
