"""Read the MATLAB files of Arrigoni et al.: adjacency matrices of the 1DSfM sets, and relative and true rotations.

`RR` of a rotation file is ``R_j R_i^T`` in slice k for the 1-based pair ``I[:, k] = (i, j)``, in our order (1DSfM's
`EGs.txt` has the transpose). `Rgt` has world-to-camera rotations, all zero where the true rotation is unknown.
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
    """Relative rotations, and true absolute ones where they are known.

    Attributes
    ----------
    num_images : int
    edges : (m, 2) int64 array
        Rows of images, 0-based.
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam_from_world_rotations : (n, 3, 3) array
        True rotations; NaN where they are unknown.
    known : (n,) bool array
        Whether the true rotation is known.
    """

    num_images: int
    edges: IntArray
    cam2_from_cam1_rotations: Array
    cam_from_world_rotations: Array
    known: NDArray[np.bool_]


def read_rotation_mat(path: str | Path) -> RotationGraph:
    """Read the rotations of a `.mat` file with variables `I`, `RR` and optionally `Rgt`.

    Raises
    ------
    DataFileError
        The file is not a MATLAB file, lacks a variable, or its values are out of range.
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
        raise DataFileError(f"{path}: I contains an index below 1 or links an image to itself")
    if not np.isfinite(relative).all():
        raise DataFileError(f"{path}: RR contains NaN or infinite values")
    return RotationGraph(num_images, pairs, so3.project(relative), truth, known)


def read_topology_mat(path: str | Path) -> tuple[int, IntArray]:
    """Read the number of images and the edges (m, 2), i < j, from the sparse adjacency matrix `A` of a `.mat` file.

    Raises
    ------
    DataFileError
        The file is not a MATLAB file or has no square matrix `A`.
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
            raise DataFileError(f"{path}: has no variable {name}")
    return content
