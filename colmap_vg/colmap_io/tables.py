"""Read the rows of a COLMAP database as arrays through sqlite, with errors that name damaged rows."""

import sqlite3
from collections import Counter
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import reading
from colmap_vg.colmap_io.memory import BYTES_PER_MATCH_IN_COLMAP, affordable_matches_per_pair, available_memory
from colmap_vg.errors import DatabaseError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNDEFINED, DEGENERATE, CALIBRATED, UNCALIBRATED, PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC, WATERMARK = range(8)
"""COLMAP's two-view configurations, as stored in a database."""
MAX_SIZE_PX, MAX_COORDINATE_PX = 2**24, 1e7
"""Maximum image size and keypoint coordinate, pixels; larger ones are damage, and their products would overflow."""
MIN_FOCAL_SHARE, MAX_FOCAL_SHARE = 1e-3, 1e6
"""Minimum and maximum ratio of focal length to image size, well beyond those of any wide-angle lens or telescope."""
MAX_PARAMETER = 1e9
"""Maximum absolute value of a camera parameter, in COLMAP's units."""
MAX_ID = 2**32 - 2
"""Maximum id: COLMAP's ids are unsigned 32-bit integers, of which the last means "none"."""

MAX_NUM_IMAGES = 2_147_483_647
"""COLMAP's pair id is ``image_id1 * MAX_NUM_IMAGES + image_id2`` with ``image_id1 < image_id2``."""


@dataclass(frozen=True, eq=False)
class DatabaseTables:
    """Cameras, images and verified pairs of a database; images ordered by id, pairs by pair id.

    Attributes
    ----------
    cameras : tuple of pycolmap.Camera
    image_ids : (n,) int64 array
    image_names : tuple of str
    camera_idx : (n,) int64 array
        Row of each image's camera.
    keypoints : tuple of (k, 2) float32 array
        Pixels, one array per image; empty for images without keypoints.
    pairs : (m, 2) int64 array
        Rows of images.
    configs : (m,) int64 array
        COLMAP's two-view configurations.
    F, E, H : (m, 3, 3) array
        NaN where the database has none.
    rotations, translations : (m, 3, 3), (m, 3) array
        Stored cam2_from_cam1; NaN where the database has none.
    offsets : (m + 1,) int64 array
        Inlier matches of pair k are rows ``offsets[k]:offsets[k + 1]`` of `matches`.
    matches : (k, 2) int64 array
        Keypoint indices in image 1 and image 2.
    caveats : tuple of str
        Sentences on what was changed or left out on reading.
    """

    cameras: tuple["pycolmap.Camera", ...]
    image_ids: IntArray
    image_names: tuple[str, ...]
    camera_idx: IntArray
    keypoints: tuple[NDArray[np.float32], ...]
    pairs: IntArray
    configs: IntArray
    F: Array
    E: Array
    H: Array
    rotations: Array
    translations: Array
    offsets: IntArray
    matches: IntArray
    caveats: tuple[str, ...] = ()

    @property
    def spherical(self) -> NDArray[np.bool_]:
        """Mask (m,) of the pairs with a spherical camera, whose pixels no matrix relates."""
        of_camera = np.array([camera.is_spherical() for camera in self.cameras], dtype=bool)
        return np.asarray(of_camera[self.camera_idx[self.pairs]].any(axis=1))

    def matched_keypoints(self, rows: IntArray, pairs: IntArray, offsets: IntArray, side: int) -> IntArray:
        """Indices (k,) of matched keypoints in the concatenation of all images' keypoints.

        Those of `rows` of `matches`, in image 1 (side 0) or 2 (side 1); `pairs` are the pairs of the rows, `offsets`
        their segments in `rows`.
        """
        starts = np.concatenate([[0], np.cumsum([len(k) for k in self.keypoints])])
        image = np.repeat(self.pairs[pairs, side], np.diff(offsets))
        return np.asarray(starts[image] + self.matches[rows, side], dtype=np.int64)


def read_tables(database_path: str | PathLike[str]) -> DatabaseTables:
    """Read the tables of a database that mapping needs, of the current or an older schema.

    Raises
    ------
    DatabaseError
        The file is not a readable COLMAP database, or a row is damaged; the message names it.
    """
    with reading(database_path) as connection:
        reader = _Reader(connection, str(database_path))
        cameras = reader.cameras()
        image_ids, names, camera_idx = reader.images({c.camera_id: k for k, c in enumerate(cameras)})
        keypoints = reader.keypoints(image_ids)
        return reader.pairs(tuple(cameras), image_ids, names, camera_idx, keypoints)


class _Reader:
    def __init__(self, connection: sqlite3.Connection, path: str) -> None:
        self._connection, self._path = connection, path

    def cameras(self) -> list["pycolmap.Camera"]:
        query = "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id"
        found: list[pycolmap.Camera] = []
        for camera_id, model, width, height, blob, prior in self._connection.execute(query):
            where = f"camera {camera_id}"
            self._check_id(camera_id, [c.camera_id for c in found[-1:]], where, MAX_ID)
            params = self._values(blob, np.float64, where)
            if not all(isinstance(side, int) and 0 < side <= MAX_SIZE_PX for side in (width, height)):
                raise self._damaged(where, f"its size is {width} x {height}")
            try:
                camera = pycolmap.Camera(
                    camera_id=camera_id, model=pycolmap.CameraModelId(model), width=width, height=height, params=params
                )
                fitting = camera.verify_params()
            except (ValueError, TypeError, RuntimeError) as error:
                raise self._damaged(where, f"camera model {model} is unknown") from error
            if not fitting:
                raise self._damaged(where, f"its {len(params)} parameters do not fit the model {camera.model_name}")
            if not (np.abs(params) < MAX_PARAMETER).all():
                raise self._damaged(where, f"its parameters are {camera.params_to_string()}")
            focals = params[list(camera.focal_length_idxs())] / max(width, height)
            if not ((focals > MIN_FOCAL_SHARE) & (focals < MAX_FOCAL_SHARE)).all():
                raise self._damaged(where, f"its focal length is {camera.mean_focal_length():g}")
            camera.has_prior_focal_length = bool(prior)
            found.append(camera)
        return found

    def images(self, camera_rows: dict[int, int]) -> tuple[IntArray, tuple[str, ...], IntArray]:
        query = "SELECT image_id, CAST(name AS BLOB), camera_id FROM images ORDER BY image_id"
        ids: list[int] = []
        names: list[str] = []
        cameras: list[int] = []
        for image_id, name, camera_id in self._connection.execute(query):
            where = f"image {image_id}"
            self._check_id(image_id, ids[-1:], where, MAX_NUM_IMAGES - 1)
            if name is not None and not isinstance(name, bytes):
                raise self._damaged(where, f"its name is {name!r}")
            try:
                names.append((name or b"").decode("utf-8"))
            except UnicodeDecodeError as error:
                raise self._damaged(where, f"its name {name!r} is not UTF-8; rename the file") from error
            if not names[-1]:
                raise self._damaged(where, "it has no name")
            if "\0" in names[-1]:
                raise self._damaged(where, f"its name is {names[-1]!r}")
            if camera_id not in camera_rows:
                raise self._damaged(f"{where} ({names[-1]})", f"it has camera {camera_id}, which does not exist")
            ids.append(image_id)
            cameras.append(camera_rows[camera_id])
        again = [name for name, count in Counter(names).items() if count > 1]
        if again:
            raise self._damaged(f"name {again[0]!r}", "several images have it")
        return np.array(ids, dtype=np.int64), tuple(names), np.array(cameras, dtype=np.int64)

    def keypoints(self, image_ids: IntArray) -> tuple[NDArray[np.float32], ...]:
        found = {int(i): np.zeros((0, 2), dtype=np.float32) for i in image_ids}
        for image_id, rows, cols, blob in self._connection.execute("SELECT image_id, rows, cols, data FROM keypoints"):
            where = f"keypoints of image {image_id}"
            points = self._values(blob, np.float32, where, rows, cols)[:, :2]
            if len(points) and points.shape[1] < 2:
                raise self._damaged(where, "they have a single coordinate")
            if not np.isfinite(points).all():
                raise self._damaged(where, "they hold NaN or infinite values")
            if np.abs(points).max(initial=0.0) > MAX_COORDINATE_PX:
                raise self._damaged(where, f"they hold coordinates of up to {np.abs(points).max():g} pixels")
            if image_id in found and len(points):
                found[image_id] = points
        return tuple(found[int(i)] for i in image_ids)

    def pairs(
        self,
        cameras: tuple["pycolmap.Camera", ...],
        image_ids: IntArray,
        names: tuple[str, ...],
        camera_idx: IntArray,
        keypoints: tuple[NDArray[np.float32], ...],
    ) -> DatabaseTables:
        columns = {row[1] for row in self._connection.execute("PRAGMA table_info(two_view_geometries)")}
        matrices = [c if c in columns else f"NULL AS {c}" for c in ("F", "E", "H", "qvec", "tvec")]
        cap, caveats = self._cap()
        rows, found = [], []
        query = (
            f"SELECT pair_id, rows, cols, data, config, {', '.join(matrices)} FROM two_view_geometries"
            " WHERE rows > 0 ORDER BY pair_id"
        )
        for pair_id, num, cols, blob, *others in self._connection.execute(query):
            if not isinstance(pair_id, int):
                raise self._damaged("matches", f"their pair has the id {pair_id!r}")
            where = f"matches of {self._pair_name(pair_id)}"
            values = self._values(blob, np.uint32, where, num, cols)
            if cols != 2 or not isinstance(others[0], int):
                raise self._damaged(where, f"they have {cols} columns and configuration {others[0]!r}")
            if 0 < cap < len(values):
                values = values[np.linspace(0, len(values) - 1, cap).astype(np.int64)]
            found.append(values)
            rows.append((pair_id, *others))
        offsets = np.concatenate([[0], np.cumsum([len(values) for values in found])]).astype(np.int64)
        matches = np.concatenate([np.zeros((0, 2), dtype=np.uint32), *found]).astype(np.int64)
        pair_ids = np.array([r[0] for r in rows], dtype=np.int64)
        pairs = self._image_rows(pair_ids, image_ids)
        self._check_matches(pairs, pair_ids, offsets, matches, keypoints)
        quaternions = self._stacked("qvec", [r[5] for r in rows], 4, pair_ids)
        return DatabaseTables(
            cameras,
            image_ids,
            names,
            camera_idx,
            keypoints,
            pairs,
            np.array([r[1] for r in rows], dtype=np.int64),
            self._stacked("F", [r[2] for r in rows], 9, pair_ids).reshape(-1, 3, 3),
            self._stacked("E", [r[3] for r in rows], 9, pair_ids).reshape(-1, 3, 3),
            self._stacked("H", [r[4] for r in rows], 9, pair_ids).reshape(-1, 3, 3),
            _rotations_from_wxyz(quaternions),
            self._stacked("tvec", [r[6] for r in rows], 3, pair_ids),
            offsets,
            matches,
            caveats,
        )

    def _cap(self) -> tuple[int, tuple[str, ...]]:
        """Maximum number of matches per pair that fits into memory (0: all), and a warning about it."""
        query = "SELECT length(data) FROM two_view_geometries WHERE rows > 0 AND typeof(data) = 'blob'"
        numbers = np.array([size // 8 for (size,) in self._connection.execute(query)], dtype=np.int64)
        memory = available_memory()
        cap = affordable_matches_per_pair(numbers, memory)
        free, total = f"{memory / 2**30:.1f} GiB of memory are free", f"{numbers.sum():,} matches"
        if cap is None:
            needed = numbers.sum() * BYTES_PER_MATCH_IN_COLMAP / 2**30
            raise DatabaseError(
                f"{self._path}: {total} of {len(numbers):,} pairs need at least {needed:.1f} GiB, but {free}: map parts"
                " of the images, match fewer pairs, or use a machine with more memory"
            )
        if cap == 0:
            return 0, ()
        return cap, (f"{total} do not fit into memory ({free}): poses are solved from {cap} of each pair at most.",)

    def _image_rows(self, pair_ids: IntArray, image_ids: IntArray) -> IntArray:
        pairs = np.stack([pair_ids // MAX_NUM_IMAGES, pair_ids % MAX_NUM_IMAGES], axis=1)
        faults = {
            "it links an image to itself": pairs[:, 0] == pairs[:, 1],
            "it links an image that does not exist": ~np.isin(pairs, image_ids).all(axis=1),
            "its images are not in the order of their ids": pairs[:, 0] > pairs[:, 1],
            "it is stored twice": np.diff(pair_ids, prepend=-1) == 0,
        }
        for what, bad in faults.items():
            if bad.any():
                raise self._damaged(self._pair_name(int(pair_ids[np.argmax(bad)])), what)
        return np.searchsorted(image_ids, pairs).astype(np.int64)

    def _check_matches(
        self,
        pairs: IntArray,
        pair_ids: IntArray,
        offsets: IntArray,
        matches: IntArray,
        keypoints: tuple[NDArray[np.float32], ...],
    ) -> None:
        if len(pairs) == 0:
            return
        num_keypoints = np.array([len(k) for k in keypoints])
        highest = np.maximum.reduceat(matches, offsets[:-1], axis=0)
        bad = np.flatnonzero((highest >= num_keypoints[pairs]).any(axis=1))
        if len(bad):
            k = bad[0]
            raise self._damaged(
                self._pair_name(int(pair_ids[k])),
                f"it uses keypoints {highest[k].tolist()} of images with {num_keypoints[pairs[k]].tolist()} keypoints",
            )

    def _stacked(self, name: str, blobs: list[object], size: int, pair_ids: IntArray) -> Array:
        out = np.full((len(blobs), size), np.nan)
        for k, blob in enumerate(blobs):
            where = f"{name} of {self._pair_name(int(pair_ids[k]))}"
            values = self._values(blob, np.float64, where)
            if len(values) not in (0, size):
                raise self._damaged(where, f"it holds {len(values)} values, expected {size}")
            if len(values):
                out[k] = values
        # Matrices and poses with extreme values count as missing: COLMAP writes none, and they would overflow.
        largest = np.abs(out).max(axis=1)
        out[~((largest > 1e-50) & (largest < 1e50))] = np.nan
        return out

    def _check_id(self, value: object, before: list[int], where: str, highest: int) -> None:
        if not isinstance(value, int) or not 0 <= value <= highest:
            raise self._damaged(where, f"its id is not between 0 and {highest}")
        if value in before:
            raise self._damaged(where, "it is stored twice")

    def _values(self, blob: object, kind: type, where: str, rows: object = None, cols: object = None) -> NDArray[Any]:
        """Values of a blob, which may be missing, in the given number of rows and columns if the table has these."""
        blob = b"" if blob is None else blob
        if not isinstance(blob, bytes) or len(blob) % np.dtype(kind).itemsize:
            raise self._damaged(where, f"the data are not whole values of {np.dtype(kind).itemsize} bytes")
        values: NDArray[Any] = np.frombuffer(blob, dtype=kind)
        if rows is None and cols is None:
            return values
        if not isinstance(rows, int) or not isinstance(cols, int) or min(rows, cols) < 0 or len(values) != rows * cols:
            raise self._damaged(where, f"it has {len(values)} values for {rows} rows of {cols}")
        return values.reshape(rows, cols)

    def _pair_name(self, pair_id: int) -> str:
        return f"pair of images {pair_id // MAX_NUM_IMAGES} and {pair_id % MAX_NUM_IMAGES}"

    def _damaged(self, where: str, what: str) -> DatabaseError:
        return DatabaseError(f"{self._path}: damaged {where}: {what}; extract and match these images again")


def _rotations_from_wxyz(q: Array) -> Array:
    """Rotation matrices of COLMAP's stored quaternions (w, x, y, z); NaN for missing or zero ones."""
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        usable = norm[:, 0] > 0
    out = np.full((len(q), 3, 3), np.nan)
    w, x, y, z = (q[usable] / norm[usable]).T
    out[usable] = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )
    return out
