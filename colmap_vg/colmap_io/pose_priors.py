"""Read the pose priors of a COLMAP database: positions by GPS or in a frame of their own, and gravity."""

import sqlite3
from collections.abc import Sequence
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import CAMERA_SENSOR, reading
from colmap_vg.errors import DatabaseError
from colmap_vg.scene.pose_priors import PosePriors

Array = NDArray[np.float64]

WGS84, CARTESIAN = 0, 1
"""COLMAP's coordinate systems of positions, as stored in a database."""
MAX_POSITION = 1e9
"""Maximum absolute Cartesian coordinate; larger ones are damage."""
_COLUMNS = ("position", "position_covariance", "gravity", "coordinate_system")


def read_pose_priors(
    database_path: str | PathLike[str], image_ids: Sequence[int]
) -> tuple[PosePriors | None, tuple[str, ...]]:
    """Read the pose priors of a database, of the current or an older schema.

    GPS positions become metres east, north and up of an origin among them. Gravity along an axis of the camera is not
    taken: COLMAP derives it from the orientation of the photograph, which is no measurement.

    Parameters
    ----------
    database_path : path
    image_ids : sequence of int

    Returns
    -------
    priors : PosePriors or None
        In the order of `image_ids`; None where no image has a position or a gravity.
    caveats : tuple of str
        Sentences on what was left out.

    Raises
    ------
    DatabaseError
        The database cannot be read, or a row is damaged.
    """
    row_of = {int(image_id): row for row, image_id in enumerate(image_ids)}
    n = len(row_of)
    values = {"position": np.full((n, 3), np.nan), "position_covariance": np.full((n, 9), np.nan)}
    values["gravity"] = np.full((n, 3), np.nan)
    system = np.full(n, -1)
    with reading(database_path) as connection:
        for image_id, *blobs, found in _rows(connection):
            if image_id not in row_of:
                continue
            row = row_of[image_id]
            for name, blob in zip(_COLUMNS[:3], blobs, strict=True):
                values[name][row] = _numbers(
                    blob, values[name].shape[1], f"{database_path}: {name} of image {image_id}"
                )
            system[row] = found if isinstance(found, int) else -1
    positions, origin, caveats = _in_metres(values["position"], system)
    covariances = _usable_covariances(values["position_covariance"].reshape(-1, 3, 3))
    priors = PosePriors(positions, covariances, _measured_gravities(values["gravity"]), origin)
    return (priors if (priors.has_position | priors.has_gravity).any() else None), caveats


def _rows(connection: sqlite3.Connection) -> list[tuple[object, ...]]:
    """Image id, position, covariance, gravity and coordinate system of all priors of cameras."""
    columns = {row[1] for row in connection.execute("PRAGMA table_info(pose_priors)")}
    if not columns:
        return []
    image = "corr_data_id" if "corr_data_id" in columns else "image_id"
    chosen = [name if name in columns else f"NULL AS {name}" for name in _COLUMNS]
    where = f" WHERE corr_sensor_type = {CAMERA_SENSOR}" if "corr_sensor_type" in columns else ""
    return connection.execute(f"SELECT {image}, {', '.join(chosen)} FROM pose_priors{where}").fetchall()


def _numbers(blob: object, size: int, where: str) -> Array:
    if blob is None or blob == b"":
        return np.full(size, np.nan)
    if not isinstance(blob, bytes) or len(blob) != 8 * size:
        raise DatabaseError(f"{where}: damaged, expected {size} numbers; extract the features again")
    return np.frombuffer(blob, dtype=np.float64)


def _in_metres(
    positions: Array, system: NDArray[np.int64]
) -> tuple[Array, tuple[float, float, float] | None, tuple[str, ...]]:
    """Positions in one Cartesian frame, the origin of GPS positions, and what was left out."""
    finite = np.isfinite(positions).all(axis=1)
    latitude, longitude = np.abs(positions[:, 0]), np.abs(positions[:, 1])
    # Receivers without a fix write zeros.
    on_earth = (latitude <= 90) & (longitude <= 360) & ((latitude > 0) | (longitude > 0))
    by_gps = finite & (system == WGS84) & on_earth & (np.abs(positions[:, 2]) < 1e6)
    cartesian = finite & (system == CARTESIAN) & (np.abs(positions) < MAX_POSITION).all(axis=1)
    chosen = by_gps if by_gps.sum() >= cartesian.sum() else cartesian
    caveats: tuple[str, ...] = ()
    ignored = int((finite & ~chosen).sum())
    if ignored:
        caveats = (
            f"{ignored} of {int(finite.sum())} position priors are ignored: they are not on Earth, have no coordinate"
            " system, or another one than the others.",
        )
    out = np.full_like(positions, np.nan)
    if chosen is cartesian or not chosen.any():
        out[chosen] = positions[chosen]
        return out, None, caveats
    out[chosen], told = east_north_up(positions[chosen])
    return out, told, caveats


def east_north_up(positions: Array) -> tuple[Array, tuple[float, float, float]]:
    """Convert GPS positions to metres about an origin among them.

    Parameters
    ----------
    positions : (k, 3) array
        Latitude and longitude in degrees, ellipsoidal height in metres (WGS84).

    Returns
    -------
    positions : (k, 3) array
        Metres east, north and up of the origin.
    origin : (float, float, float)
        Latitude, longitude and height.
    """
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    on_ellipsoid = np.asarray(earth.ellipsoid_to_ecef(positions))
    origin = np.asarray(earth.ecef_to_ellipsoid(np.median(on_ellipsoid, axis=0)[None]))[0]
    # A round origin can be typed again: 1e-6 degrees are a tenth of a metre.
    told = (round(float(origin[0]), 6), round(float(origin[1]), 6), round(float(origin[2]), 1))
    return np.asarray(earth.ellipsoid_to_enu(positions, *told)), told


def _usable_covariances(covariances: Array) -> Array:
    """Covariances, NaN where they are not symmetric and positive definite."""
    with np.errstate(invalid="ignore"):
        size = np.abs(covariances).max(axis=(1, 2), initial=0.0)
        symmetric = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2), initial=0.0) <= 1e-9 * size
    usable = np.isfinite(size) & symmetric & (size > 0)
    least = np.linalg.eigvalsh(np.where(usable[:, None, None], covariances, np.eye(3)))[:, 0]
    usable &= least > 1e-12 * np.where(usable, size, 1.0)
    return np.where(usable[:, None, None], covariances, np.nan)


def _measured_gravities(gravities: Array) -> Array:
    """Unit gravities, NaN where they are missing or lie along an axis of the camera."""
    with np.errstate(invalid="ignore"):
        unit = gravities / np.linalg.norm(gravities, axis=1, keepdims=True)
        measured = np.isfinite(unit).all(axis=1) & (np.abs(unit).max(axis=1) < 1.0 - 1e-9)
    return np.where(measured[:, None], unit, np.nan)
