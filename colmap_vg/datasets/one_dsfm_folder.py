"""Read folders of the 1DSfM data sets (Wilson & Snavely, ECCV 2014): `EGs.txt`, `cc.txt`, `list.txt`, `coords.txt`.

A row of `EGs.txt` is ``i j R_ij (9, row-major) t_ij (3)`` with ``R_ij = R_i R_j^T`` for world-to-camera rotations and
``t_ij`` the position of camera j in camera i's frame. Its cameras look along -z with y up; with
``F = diag(1, -1, -1)`` the relative pose between COLMAP cameras (x right, y down, z forward) is ``F R_ij^T F`` and the
direction ``F t_ij``.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.datasets.rows import read_rows, read_text
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3
from colmap_vg.scene.view_graph import ViewGraph

BUNDLER_FROM_COLMAP_AXES = np.diag([1.0, -1.0, -1.0])
"""Transformation from COLMAP's to Bundler's camera axes: y and z change sign. It is its own inverse."""


def read_1dsfm(folder: str | Path) -> ViewGraph:
    """Read the viewing graph of a 1DSfM folder, restricted to the images of `cc.txt` (largest component) if it exists.

    Parameters
    ----------
    folder : path
        Contains `EGs.txt`; `cc.txt` (image indices of the component), `list.txt` (names) and `coords.txt` (feature
        counts, not used) are optional.

    Returns
    -------
    ViewGraph
        `image_ids` are the data set's image indices, 0-based as in `list.txt`, in ascending order.

    Raises
    ------
    DataFileError
        A file is missing or has a bad row; the message names file and line.
    """
    folder = Path(folder)
    edge_file = folder / "EGs.txt"
    rows = read_rows(edge_file, 14, "i j R_ij(9) t_ij(3)")
    pairs = _indices(edge_file, rows[:, :2], "image index")
    relative = rows[:, 2:11].reshape(-1, 3, 3)
    _refuse(edge_file, pairs[:, 0] == pairs[:, 1], "links an image to itself")
    skewed = np.abs(relative @ np.swapaxes(relative, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0) > 1e-3
    _refuse(edge_file, skewed | (np.linalg.det(relative) < 0), "contains no rotation matrix")
    length = np.linalg.norm(rows[:, 11:], axis=1)
    _refuse(edge_file, length < 1e-9, "contains a zero translation")

    images = np.unique(pairs)
    if (folder / "cc.txt").exists():
        images = np.unique(_indices(folder / "cc.txt", read_rows(folder / "cc.txt", 1, "image index"), "image index"))
        inside = np.isin(pairs, images).all(axis=1)
        pairs, relative, rows, length = pairs[inside], relative[inside], rows[inside], length[inside]
    F = BUNDLER_FROM_COLMAP_AXES
    return ViewGraph(
        image_ids=images,
        edges=np.searchsorted(images, pairs),
        cam2_from_cam1_rotations=so3.project(F @ np.swapaxes(relative, 1, 2) @ F),
        cam2_in_cam1_directions=rows[:, 11:] / length[:, None] @ F,
        image_names=_names(folder / "list.txt", images),
    )


def _names(path: Path, images: NDArray[np.int64]) -> tuple[str, ...]:
    """Read the names of images from `list.txt` (name, then optional focal length columns); () without the file."""
    if not path.exists():
        return ()
    names = [line.split()[0] for line in read_text(path).splitlines() if line.strip()]
    if len(images) and images[-1] >= len(names):
        raise DataFileError(f"{path}: {len(names)} names, but the edges use image index {images[-1]}")
    return tuple(names[i] for i in images)


def _indices(path: Path, values: NDArray[np.float64], meaning: str) -> NDArray[np.int64]:
    bad = (values != np.floor(values)) | (values < 0)
    _refuse(path, bad.reshape(len(values), -1).any(axis=1), f"has a negative or fractional {meaning}")
    return values.astype(np.int64)


def _refuse(path: Path, bad: NDArray[np.bool_], what: str) -> None:
    """Raise an error that names the line of the first bad row."""
    rows = np.flatnonzero(bad)
    if len(rows):
        text = read_text(path).splitlines()
        numbers = [number for number, line in enumerate(text, start=1) if line.split("#", 1)[0].strip()]
        raise DataFileError(f"{path}:{numbers[rows[0]]}: {what} ({len(rows)} such rows)")
