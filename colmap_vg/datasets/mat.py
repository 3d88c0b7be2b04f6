"""MATLAB files of Arrigoni et al.: adjacency matrices of the 1DSfM sets, and relative rotations with truth.

`RR` of a rotation file holds ``R_j R_i^T`` in slice k for the 1-based pair ``I[:, k] = (i, j)``, in our order (1DSfM's
`EGs.txt` holds the transpose). `Rgt` holds world-to-camera rotations, all zero where the truth is unknown.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.io.matlab import MatReadError

from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RotationGraph:
    """Relative rotations, and absolute ones where they are known.

    Attributes
    ----------
    num_images : int
    edges : (m, 2) int64 array
        Rows, counted from 0.
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam_from_world_rotations : (n, 3, 3) array
        Truth; NaN where it is unknown.
    known : (n,) bool array
    """

    num_images: int
    edges: IntArray
    cam2_from_cam1_rotations: Array
    cam_from_world_rotations: Array
    known: NDArray[np.bool_]


def read_rotation_mat(path: str | Path) -> RotationGraph:
    """Relative rotations of a `.mat` file with `I`, `RR` and, when present, `Rgt`.

    Raises
    ------
    DataFileError
        The file is no MATLAB file, lacks a variable, or its values are out of range.
    """
    content = _load(path, ("I", "RR"))
    pairs = np.asarray(content["I"], dtype=np.int64).T - 1
    relative = np.moveaxis(np.asarray(content["RR"], dtype=float), -1, 0)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or relative.shape != (len(pairs), 3, 3):
        raise DataFileError(
            f"{path}: I is {content['I'].shape} and RR {content['RR'].shape}; expected (2, m), (3, 3, m)"
        )
    num_images = int(pairs.max()) + 1 if len(pairs) else 0
    truth = np.full((num_images, 3, 3), np.nan)
    known = np.zeros(num_images, dtype=bool)
    if "Rgt" in content:
        given = np.moveaxis(np.asarray(content["Rgt"], dtype=float), -1, 0)
        if given.shape[1:] != (3, 3) or len(given) < num_images:
            raise DataFileError(f"{path}: Rgt is {content['Rgt'].shape} for {num_images} images")
        num_images, known = len(given), np.abs(given).sum(axis=(1, 2)) > 0
        truth = np.full((num_images, 3, 3), np.nan)
        truth[known] = so3.project(given[known])
    if len(pairs) and (pairs.min() < 0 or (pairs[:, 0] == pairs[:, 1]).any()):
        raise DataFileError(f"{path}: I holds an index below 1 or links an image to itself")
    if not np.isfinite(relative).all():
        raise DataFileError(f"{path}: RR holds NaN or infinite values")
    return RotationGraph(num_images, pairs, so3.project(relative), truth, known)


def read_topology_mat(path: str | Path) -> tuple[int, IntArray]:
    """Number of images and edges (m, 2), i < j, of the sparse adjacency matrix `A` of a `.mat` file.

    Raises
    ------
    DataFileError
        The file is no MATLAB file or holds no square matrix `A`.
    """
    A = sp.coo_array(_load(path, ("A",))["A"])
    if A.ndim != 2 or A.shape[0] != A.shape[1]:
        raise DataFileError(f"{path}: A is {A.shape}, expected a square adjacency matrix")
    linked = (A.data != 0) & (A.row != A.col)
    pairs = np.sort(np.stack([A.row[linked], A.col[linked]], axis=1), axis=1)
    return int(A.shape[0]), np.unique(pairs, axis=0).astype(np.int64)


def _load(path: str | Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        content: dict[str, Any] = scipy.io.loadmat(path)
    except (OSError, ValueError, NotImplementedError, TypeError, MatReadError) as error:
        raise DataFileError(f"{path}: cannot be read as a MATLAB file ({error})") from error
    for name in names:
        if name not in content:
            raise DataFileError(f"{path}: holds no variable {name}")
    return content
