"""Undistort all keypoints of a database."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import undistorted_pixels
from colmap_vg.colmap_io.tables import DatabaseTables

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def undistorted_keypoints(tables: DatabaseTables) -> tuple[Array, BoolArray]:
    """Undistort the keypoints of all images, concatenated, with the database's calibrations.

    Fundamental matrices hold for pinhole cameras; distortion would bias the focal lengths estimated from them.

    Parameters
    ----------
    tables : DatabaseTables

    Returns
    -------
    pixels : (k, 2) array
        NaN where `valid` is False.
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
