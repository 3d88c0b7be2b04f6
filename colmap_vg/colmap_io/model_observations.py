"""The points of a COLMAP model and their observations as arrays.

Asking pycolmap for each keypoint takes 3 microseconds; COLMAP writes all of them into a file in a tenth of that time.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.errors import OutputError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_POSE_AND_CAMERA = 4 + 7 * 8 + 4
"""Bytes of an image's id, pose and camera in COLMAP's binary file, before its name."""
_POINT, _TRACK_LENGTH, _TRACK_ELEMENT = 8 + 3 * 8, 8 + 3 * 8 + 3 + 8, 8
"""Bytes of a point's id and position, those before the length of its track, and those of an image and its keypoint."""
_NO_POINT = np.iinfo(np.uint64).max


@dataclass(frozen=True, eq=False)
class ModelObservations:
    """Points of a model and their observations in its registered images.

    Attributes
    ----------
    image_ids, point_ids : (k,) int64 array
        Image and point of each observation; images ascend.
    keypoints : (k, 2) array
        Pixels.
    every_point : (q,) int64 array
        Ids of all points, ascending.
    positions : (q, 3) array
        World frame.
    """

    image_ids: IntArray
    point_ids: IntArray
    keypoints: Array
    every_point: IntArray
    positions: Array

    @classmethod
    def of(cls, reconstruction: "pycolmap.Reconstruction") -> Self:
        """Collect the points and observations of a reconstruction.

        Raises
        ------
        OutputError
            The temporary folder has no room for the model.
        """
        with tempfile.TemporaryDirectory() as folder:
            reconstruction.write_binary(folder)
            content = (Path(folder) / "images.bin").read_bytes()
            points = (Path(folder) / "points3D.bin").read_bytes()
        found = {i: own[own["point_id"] != _NO_POINT] for i, own in keypoint_records(content).items()}
        rows = np.concatenate([found[image_id] for image_id in sorted(found)] or [np.empty(0, _KEYPOINT)])
        every_point, positions = _points(points, *np.unique(rows["point_id"], return_counts=True))
        return cls(
            image_ids=np.repeat(sorted(found), [len(found[image_id]) for image_id in sorted(found)]).astype(np.int64),
            point_ids=rows["point_id"].astype(np.int64),
            keypoints=np.ascontiguousarray(rows["xy"]),
            every_point=every_point,
            positions=positions,
        )

    def of_points_in(self, image_ids: list[int]) -> Self:
        """All observations of the points that some of the given images see; `every_point` stays."""
        wanted = np.unique(self.point_ids[np.isin(self.image_ids, image_ids)])
        rows = np.flatnonzero(np.isin(self.point_ids, wanted))
        return replace(
            self, image_ids=self.image_ids[rows], point_ids=self.point_ids[rows], keypoints=self.keypoints[rows]
        )

    def positions_of(self, point_ids: IntArray) -> Array:
        """Positions (n, 3) of some points of the model."""
        return np.asarray(self.positions[np.searchsorted(self.every_point, point_ids)])


def keypoint_records(content: bytes | bytearray) -> dict[int, NDArray[np.void]]:
    """Find the keypoints of each image in COLMAP's binary file of images.

    Parameters
    ----------
    content : bytes or bytearray
        The file.

    Returns
    -------
    dict of int to (k,) array of records
        For each image id `xy`, pixels, and `point_id`. They can be changed within a bytearray.

    Raises
    ------
    OutputError
        The file is cut short, since the temporary folder has no room for the model.
    """
    found, place = {}, 8
    _check_room(len(content) >= place)
    for _ in range(int.from_bytes(content[:8], "little")):
        image_id = int.from_bytes(content[place : place + 4], "little")
        place = content.find(b"\0", place + _POSE_AND_CAMERA) + 1
        _check_room(place > 0)
        count = int.from_bytes(content[place : place + 8], "little")
        _check_room(place + 8 + count * _KEYPOINT.itemsize <= len(content))
        found[image_id] = np.frombuffer(content, _KEYPOINT, count, place + 8)
        place += 8 + count * _KEYPOINT.itemsize
    return found


def _points(content: bytes, observed: NDArray[np.uint64], counts: IntArray) -> tuple[IntArray, Array]:
    """Ids (q,), ascending, and positions (q, 3) of the points in COLMAP's binary file.

    It holds the observed points with tracks of as many elements as they have observations, in the order of their ids,
    unless some point has none: then each record tells where the next one starts.
    """
    ends = 8 + np.cumsum(_TRACK_LENGTH + 8 + _TRACK_ELEMENT * counts)
    starts = np.concatenate([[8], ends]).astype(np.int64)
    if starts[-1] == len(content):
        heads = _heads(content, starts[:-1])
        if np.array_equal(heads["id"], observed):
            return heads["id"].astype(np.int64), np.ascontiguousarray(heads["xyz"])
    places, place = [], 8
    for _ in range(int.from_bytes(content[:8], "little")):
        places.append(place)
        length = place + _TRACK_LENGTH
        place = length + 8 + _TRACK_ELEMENT * int.from_bytes(content[length : length + 8], "little")
    _check_room(place == len(content))
    heads = _heads(content, np.array(places, dtype=np.int64))
    heads = heads[np.argsort(heads["id"], kind="stable")]
    return heads["id"].astype(np.int64), np.ascontiguousarray(heads["xyz"])


def _heads(content: bytes, starts: IntArray) -> NDArray[np.void]:
    """Records (q,) of id and position that begin at some bytes."""
    bytes_of_heads = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(_POINT)]
    return np.asarray(bytes_of_heads.view(np.dtype([("id", "<u8"), ("xyz", "<f8", 3)])).reshape(-1))


def no_room() -> OutputError:
    """The error where the temporary folder has no room for a model."""
    return OutputError(
        f"{tempfile.gettempdir()}: the model does not fit into the temporary folder. Free some space, or set TMPDIR to"
        " a larger one."
    )


def _check_room(is_whole: bool) -> None:
    if not is_whole:
        raise no_room()
