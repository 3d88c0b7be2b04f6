"""All keypoints of a database as pinhole cameras would see them."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import undistorted_pixels
from colmap_vg.colmap_io.tables import DatabaseTables

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def undistorted_keypoints(tables: DatabaseTables) -> tuple[Array, BoolArray]:
    """Keypoints of all images one after the other, undistorted by the database's calibrations.

    Fundamental matrices are those of pinhole cameras; what a lens bends would be taken for another focal length.

    Parameters
    ----------
    tables : DatabaseTables

    Returns
    -------
    pixels : (k, 2) array
        NaN where a lens has no ray.
    valid : (k,) bool array
        See `undistorted_pixels`.
    """
    camera = np.repeat(tables.camera_idx, [len(keypoints) for keypoints in tables.keypoints])
    pixels = np.concatenate([*tables.keypoints, np.zeros((0, 2))]).astype(np.float64)
    valid = np.zeros(len(pixels), dtype=bool)
    for row, lens in enumerate(tables.cameras):
        own = camera == row
        pixels[own], valid[own] = undistorted_pixels(lens, pixels[own])
    return pixels, valid
