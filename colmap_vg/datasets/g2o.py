"""Read pose graphs in g2o's text format (``VERTEX_SE3:QUAT``, ``EDGE_SE3:QUAT``).

A vertex is ``id x y z qx qy qz qw``, the pose of camera (or robot) in the world: its position, and its rotation from
camera to world. An edge is ``i j x y z qx qy qz qw`` and the upper triangle of a 6 x 6 information matrix: camera j's
pose in camera i's frame. g2o's error is ``T_ij^-1 T_i^-1 T_j``, translation first. As in GTSAM and SE-Sync, the
rotation part of the information is interpreted as that of the rotation vector.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.datasets.rows import read_text
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3

Array = NDArray[np.float64]

_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_NUM_VALUES = {_VERTEX: 8, _EDGE: 30}


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A pose graph in this package's conventions, ready for :func:`colmap_vg.pose_graph.gauss_newton.solve_pose_graph`.

    Attributes
    ----------
    ids : (n,) int64 array
        Vertex ids in the order of the file.
    cam_from_world_rotations : (n, 3, 3) array
        Initial rotations in the file.
    projection_centers : (n, 3) array
        Initial positions in the file, world frame.
    edges : (m, 2) int64 array
        Rows into `ids`.
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_translations : (m, 3) array
        Camera 2's centre in camera 1's frame.
    information : (m, 6, 6) array
        Of the rotation vector in camera 2's frame (first) and the translation in camera 1's frame.
    """

    ids: NDArray[np.int64]
    cam_from_world_rotations: Array
    projection_centers: Array
    edges: NDArray[np.int64]
    cam2_from_cam1_rotations: Array
    cam2_in_cam1_translations: Array
    information: Array

    def chordal_weights(self) -> tuple[Array, Array]:
        """Scalar weights of rotations and translations: ``3 / (2 tr Sigma_R)``, ``3 / tr Sigma_t``, (m,) each.

        The maximum-likelihood weights of the isotropic noise nearest to the edge's (Rosen et al., SE-Sync, 2019).
        """
        rotation, translation = self.information[:, :3, :3], self.information[:, 3:, 3:]
        kappa = 1.5 / np.trace(np.linalg.inv(rotation), axis1=1, axis2=2)
        return kappa, 3.0 / np.trace(np.linalg.inv(translation), axis1=1, axis2=2)


def read_g2o(path: str | PathLike[str]) -> PoseGraph:
    """Read a 3-D pose graph.

    Parameters
    ----------
    path : path

    Returns
    -------
    PoseGraph

    Raises
    ------
    DataFileError
        The file cannot be read or a line is bad; the message names file and line.
    """
    path = Path(path)
    values: dict[str, list[list[float]]] = {_VERTEX: [], _EDGE: []}
    lines: dict[str, list[int]] = {_VERTEX: [], _EDGE: []}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words or words[0] == "FIX":  # the solver fixes the gauge
            continue
        values.get(words[0], []).append(_numbers(path, number, words))
        lines[words[0]].append(number)
    vertices, edges = (np.array(values[tag]).reshape(-1, _NUM_VALUES[tag]) for tag in (_VERTEX, _EDGE))
    if not len(vertices):
        raise DataFileError(f"{path}: no {_VERTEX} line; only 3-D pose graphs with initial poses can be read")
    ids = _identifiers(path, lines[_VERTEX], vertices[:, 0])
    order = np.argsort(ids, kind="stable")
    again = np.flatnonzero(np.diff(ids[order]) == 0)
    if len(again):
        row = int(order[again[0] + 1])
        raise DataFileError(f"{path}:{lines[_VERTEX][row]}: vertex {ids[row]} is listed twice")
    rows = _vertex_rows(path, lines[_EDGE], ids, order, edges[:, :2])
    world_from_cam = _rotations(path, lines[_VERTEX], vertices[:, 4:8])
    cam1_from_cam2 = _rotations(path, lines[_EDGE], edges[:, 5:9])
    cam2_from_cam1 = np.swapaxes(cam1_from_cam2, 1, 2)
    return PoseGraph(
        ids=ids,
        cam_from_world_rotations=np.swapaxes(world_from_cam, 1, 2),
        projection_centers=vertices[:, 1:4],
        edges=rows,
        cam2_from_cam1_rotations=cam2_from_cam1,
        cam2_in_cam1_translations=edges[:, 2:5],
        information=_information(edges[:, 9:], cam2_from_cam1),
    )


def _numbers(path: Path, number: int, words: list[str]) -> list[float]:
    if words[0] not in _NUM_VALUES:
        raise DataFileError(f"{path}:{number}: {words[0]} is unknown; 3-D pose graphs have {_VERTEX} and {_EDGE}")
    if len(words) - 1 != _NUM_VALUES[words[0]]:
        raise DataFileError(f"{path}:{number}: {words[0]} needs {_NUM_VALUES[words[0]]} values, found {len(words) - 1}")
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError as error:
        raise DataFileError(f"{path}:{number}: {error}") from error
    if not np.isfinite(numbers).all():
        raise DataFileError(f"{path}:{number}: NaN or infinite value")
    return numbers


def _identifiers(path: Path, lines: list[int], values: Array) -> NDArray[np.int64]:
    broken = np.flatnonzero((values != np.round(values)) | (values < 0) | (values > 2**53))
    if len(broken):
        row = int(broken[0])
        raise DataFileError(f"{path}:{lines[row]}: {values[row]} is not a vertex id")
    return values.astype(np.int64)


def _vertex_rows(
    path: Path, lines: list[int], ids: NDArray[np.int64], order: NDArray[np.int64], ends: Array
) -> NDArray[np.int64]:
    """Rows (m, 2) of the edges' vertices, from their ids."""
    wanted = np.stack([_identifiers(path, lines, ends[:, k]) for k in range(2)], axis=1)
    place = np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)
    rows = order[place]
    bad = np.flatnonzero((ids[rows] != wanted).any(axis=1) | (wanted[:, 0] == wanted[:, 1]))
    if len(bad):
        k = int(bad[0])
        raise DataFileError(
            f"{path}:{lines[k]}: an edge from {wanted[k, 0]} to {wanted[k, 1]} needs two different vertices of the file"
        )
    return np.asarray(rows, dtype=np.int64)


def _rotations(path: Path, lines: list[int], quaternions: Array) -> Array:
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > 1e-2)
    if len(bad):
        k = int(bad[0])
        raise DataFileError(f"{path}:{lines[k]}: the quaternion has length {length[k]:.6g} instead of 1")
    return so3.from_quaternion(quaternions)


def _information(upper: Array, cam2_from_cam1: Array) -> Array:
    """Convert information matrices from g2o's error ``(R_ij s, -w)`` to ours ``(w, s)``, (m, 6, 6)."""
    m, (rows, cols) = len(upper), np.triu_indices(6)
    given = np.zeros((m, 6, 6))
    given[:, rows, cols] = upper
    given[:, cols, rows] = upper
    ours_to_theirs = np.zeros((m, 6, 6))
    ours_to_theirs[:, :3, 3:] = cam2_from_cam1
    ours_to_theirs[:, 3:, :3] = -np.eye(3)
    return np.asarray(np.swapaxes(ours_to_theirs, 1, 2) @ given @ ours_to_theirs)
