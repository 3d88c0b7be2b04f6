"""Add many points to a COLMAP model at once, through its binary files: one by one they take ten times as long."""

import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.loading import with_other_images
from colmap_vg.colmap_io.model_observations import keypoint_records, no_room

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_HEAD = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_ELEMENT = np.dtype([("image_id", "<u4"), ("keypoint", "<u4")])


def keypoints_of_images(reconstruction: "pycolmap.Reconstruction") -> dict[int, Array]:
    """Pixels (k, 2) of the keypoints of each registered image.

    Raises
    ------
    OutputError
        The temporary folder has no room for the model.
    """
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        records = keypoint_records((Path(folder) / "images.bin").read_bytes())
    return {image_id: np.ascontiguousarray(own["xy"]) for image_id, own in records.items()}


def with_points(
    reconstruction: "pycolmap.Reconstruction",
    cache: "pycolmap.DatabaseCache",
    positions: Array,
    point_row: IntArray,
    image_ids: IntArray,
    keypoint_idx: IntArray,
) -> "pycolmap.Reconstruction":
    """Copy a model without points, and add points.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
        Without points.
    cache : pycolmap.DatabaseCache
        Of the database whose images and ids the model has.
    positions : (q, 3) array
        World frame; the points get the ids 1 to q.
    point_row, image_ids, keypoint_idx : (k,) int64 array
        Point, registered image, and index of the keypoint of each observation, sorted by point. Each point has one
        observation at least.

    Returns
    -------
    pycolmap.Reconstruction

    Raises
    ------
    OutputError
        The temporary folder has no room for the model.
    """
    model = pycolmap.Reconstruction()
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        content = bytearray((Path(folder) / "images.bin").read_bytes())
        records, by_image = keypoint_records(content), np.argsort(image_ids, kind="stable")
        found, starts = np.unique(image_ids[by_image], return_index=True)
        for image_id, start, end in zip(found.tolist(), starts, np.append(starts[1:], len(by_image)), strict=False):
            own = by_image[start:end]
            records[image_id]["point_id"][keypoint_idx[own]] = point_row[own] + 1
        points = _points(positions, point_row, image_ids, keypoint_idx)
        try:
            (Path(folder) / "images.bin").write_bytes(content)
            (Path(folder) / "points3D.bin").write_bytes(points)
        except OSError as error:
            raise no_room() from error
        model.read_binary(folder)
    with_other_images(model, cache)
    return model


def _points(positions: Array, point_row: IntArray, image_ids: IntArray, keypoint_idx: IntArray) -> bytes:
    """COLMAP's binary file of points: heads of fixed size, each followed by its track."""
    heads, elements = np.zeros(len(positions), dtype=_HEAD), np.empty(len(point_row), dtype=_ELEMENT)
    heads["id"], heads["xyz"], heads["error"] = np.arange(len(positions)) + 1, positions, -1.0
    heads["length"] = np.bincount(point_row, minlength=len(positions))
    elements["image_id"], elements["keypoint"] = image_ids, keypoint_idx
    starts = np.arange(len(positions)) * _HEAD.itemsize
    starts[1:] += np.cumsum(heads["length"]).astype(np.int64)[:-1] * _ELEMENT.itemsize
    content = np.zeros(heads.nbytes + elements.nbytes, dtype=np.uint8)
    of_tracks = np.ones(len(content), dtype=bool)
    of_heads = starts[:, None] + np.arange(_HEAD.itemsize)
    of_tracks[of_heads] = False
    content[of_heads] = heads.view(np.uint8).reshape(len(heads), _HEAD.itemsize)
    content[of_tracks] = elements.view(np.uint8)
    return len(positions).to_bytes(8, "little") + content.tobytes()
