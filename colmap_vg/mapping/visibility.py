"""Which points of a model lie in the frames of which images, and which images see them."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MAX_NUM_POINTS = 3000
"""Points that are looked for in all images, the same share of each track length."""
MIN_TRACK_LENGTH = 3
NEAR_DEG = 15.0
"""An image should see a point in its frame where another image sees it, at the point, from this near."""


@dataclass(frozen=True, eq=False)
class SampledTracks:
    """Points that three images or more see.

    Attributes
    ----------
    points : (k, 3) array
    sees : (k, n) bool array
        Images that see each.
    num_observations : int
        Of all such points, the ones that were not sampled among them.
    """

    points: Array
    sees: BoolArray
    num_observations: int


def sampled_tracks(
    reconstruction: "pycolmap.Reconstruction", image_ids: list[int], max_num_points: int = MAX_NUM_POINTS
) -> SampledTracks:
    """An even sample of a model's points by their tracks' lengths.

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
    """Points (k, 3) that project into each image, (k, n)."""
    inside = np.zeros((len(xyz), len(image_ids)), dtype=bool)
    for column, image_id in enumerate(image_ids):
        image = reconstruction.image(image_id)
        camera = reconstruction.camera(image.camera_id)
        local = image.cam_from_world() * xyz
        front = np.flatnonzero(local[:, 2] > 0)
        pixels = np.asarray(camera.img_from_cam(local[front]), dtype=np.float64).reshape(-1, 2)
        size = np.array([camera.width, camera.height])
        inside[front, column] = ((pixels >= 0) & (pixels < size)).all(axis=1)
    return inside
