"""Visibility of a model's points: which images observe them, and into which images they project."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]
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
    points : (k, 3) array
        World frame.
    sees : (k, n) bool array
        Whether each image sees each point.
    num_observations : int
        Number of observations of all such points, sampled or not.
    """

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
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    tracks = [
        (point.xyz, sorted({row_of[element.image_id] for element in point.track.elements}))
        for _, point in sorted(reconstruction.points3D.items())
    ]
    tracks = sorted((t for t in tracks if len(t[1]) >= MIN_TRACK_LENGTH), key=lambda t: len(t[1]))
    if not tracks:
        return SampledTracks(np.zeros((0, 3)), np.zeros((0, len(image_ids)), dtype=bool), 0)
    sampled = [tracks[k] for k in np.unique(np.linspace(0, len(tracks) - 1, max_num_points).astype(int))]
    sees = np.zeros((len(sampled), len(image_ids)), dtype=bool)
    for row, (_, seen_in) in enumerate(sampled):
        sees[row, seen_in] = True
    return SampledTracks(np.array([position for position, _ in sampled]), sees, sum(len(seen) for _, seen in tracks))


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
