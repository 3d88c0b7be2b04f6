"""Databases with measured positions: GPS or Cartesian priors, some of them wrong."""

from pathlib import Path

import numpy as np
import pycolmap

ORIGIN = (47.3, 8.5, 440.0)
"""Latitude, longitude and height of the frame that positions are given in."""


def prior(
    image_id: int, position: np.ndarray, system: str = "CARTESIAN", sigma: float | None = None
) -> pycolmap.PosePrior:
    """A position prior of an image."""
    found = pycolmap.PosePrior(position=position)
    if sigma is not None:
        found.position_covariance = sigma**2 * np.eye(3)
    found.coordinate_system = getattr(pycolmap.PosePriorCoordinateSystem, system)
    found.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), image_id)
    return found


def write_priors(path: Path, priors: list[pycolmap.PosePrior]) -> None:
    """Add priors to a database."""
    with pycolmap.Database.open(path) as database:
        for each in priors:
            database.write_pose_prior(each)


def by_gps(positions: np.ndarray) -> np.ndarray:
    """Latitude, longitude and height of positions east, north and up of `ORIGIN`."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(earth.enu_to_ellipsoid(positions, *ORIGIN))


def east_north_up(latitude: float, longitude: float, height: float, origin: tuple[float, float, float]) -> np.ndarray:
    """Position in metres about an origin, from the definition of the WGS84 ellipsoid."""
    return _turn(*origin[:2]) @ (_geocentric(latitude, longitude, height) - _geocentric(*origin))


def _geocentric(latitude: float, longitude: float, height: float) -> np.ndarray:
    a, b = 6378137.0, 6356752.314245
    phi, lam = np.radians([latitude, longitude])
    radius = a**2 / np.hypot(a * np.cos(phi), b * np.sin(phi))
    across = (radius + height) * np.cos(phi)
    return np.array([across * np.cos(lam), across * np.sin(lam), (radius * (b / a) ** 2 + height) * np.sin(phi)])


def _turn(latitude: float, longitude: float) -> np.ndarray:
    phi, lam = np.radians([latitude, longitude])
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    return np.array([east, north, np.cross(east, north)])
