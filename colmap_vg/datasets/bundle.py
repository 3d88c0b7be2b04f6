"""Read Bundler's `bundle.out` format, which the 1DSfM data sets use for their ground truth (`gt_bundle.out`).

A camera is ``f k1 k2``, a world-to-camera rotation and a translation ``t``, and looks along -z. With COLMAP's camera
axes the rotation is ``F R``, where ``F = diag(1, -1, -1)``, and the centre is ``-R^T t``.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.datasets.one_dsfm_folder import BUNDLER_FROM_COLMAP_AXES
from colmap_vg.datasets.rows import read_text
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3

Array = NDArray[np.float64]

_CAMERA_LINES = 5


def read_bundle(path: str | Path) -> dict[int, tuple[Array, Array]]:
    """Read the camera poses of a Bundler file.

    Parameters
    ----------
    path : path
        ``gt_bundle.out`` or any Bundler v0.3 file.

    Returns
    -------
    dict of int to (cam_from_world_rotation (3, 3), projection_center (3,))
        By camera index, with COLMAP's camera axes. Cameras with focal length 0 are not registered and are skipped.

    Raises
    ------
    DataFileError
        The file cannot be read or a line is bad; the message names file and line.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    start = 1 if lines and lines[0].lstrip().startswith("#") else 0
    if len(lines) <= start:
        raise DataFileError(f"{path}: empty, expected a Bundler file that begins with the number of cameras and points")
    counts = _numbers(path, lines, start, 2)
    num_cameras = int(counts[0])
    if num_cameras < 0 or num_cameras != counts[0]:
        raise DataFileError(f"{path}:{start + 1}: {counts[0]} is not a valid number of cameras")
    poses: dict[int, tuple[Array, Array]] = {}
    for camera in range(num_cameras):
        first = start + 1 + _CAMERA_LINES * camera
        if _numbers(path, lines, first, 3)[0] == 0.0:
            continue
        R = np.stack([_numbers(path, lines, first + row, 3) for row in (1, 2, 3)])
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise DataFileError(f"{path}:{first + 2}: the rotation of camera {camera} is not a rotation matrix")
        t = _numbers(path, lines, first + 4, 3)
        poses[camera] = (so3.project(BUNDLER_FROM_COLMAP_AXES @ R), -R.T @ t)
    return poses


def _numbers(path: Path, lines: list[str], row: int, count: int) -> Array:
    if row >= len(lines):
        raise DataFileError(f"{path}: ends after line {len(lines)}, in the middle of the cameras")
    words = lines[row].split()
    if len(words) != count:
        raise DataFileError(f"{path}:{row + 1}: {len(words)} values, expected {count}")
    try:
        values = np.array([float(w) for w in words])
    except ValueError as error:
        raise DataFileError(f"{path}:{row + 1}: {error}") from error
    if not np.isfinite(values).all():
        raise DataFileError(f"{path}:{row + 1}: NaN or infinite value")
    return values
