"""Operations on COLMAP cameras: bearings of keypoints, calibration matrices, changes of focal length and distortion."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized

Array = NDArray[np.float64]

MAX_ANGLE_DEG = 70.0
"""Maximum angle between a ray and the optical axis for undistorted pixels, degrees."""
MAX_REPROJECTION_PX = 0.5
"""Maximum distance between a keypoint and the projection of its ray, pixels: some camera models return wrong rays
outside their field of view."""


def focal_length(camera: "pycolmap.Camera") -> float:
    """Mean focal length in pixels; of spherical cameras, which have none, the pixels of a radian."""
    return float(camera.width / (2.0 * np.pi) if camera.is_spherical() else camera.mean_focal_length())


def bearings_of_keypoints(camera: "pycolmap.Camera", points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Compute the unit rays of pixels in the camera's frame.

    Parameters
    ----------
    camera : pycolmap.Camera
    points : (k, 2) array
        Pixels.

    Returns
    -------
    bearings : (k, 3) array
        Unit vectors; the optical axis where the camera model gives no ray.
    valid : (k,) bool array
        Whether the ray projects back to its pixel; in front of the camera, unless that is spherical.
    """
    points = np.ascontiguousarray(points, dtype=float)
    rays = np.ones((len(points), 3))
    if len(points) == 0:
        return rays, np.zeros(0, dtype=bool)
    if camera.is_spherical():
        inside = np.isfinite(points).all(axis=1) & (points[:, 1] >= 0.0) & (points[:, 1] <= camera.height)
        rays[:] = camera.cam_ray_from_img(np.where(inside[:, None], points, 0.0))
        rays[~inside] = (0.0, 0.0, 1.0)
        return normalized(rays), np.asarray(inside)
    rays[:, :2] = camera.cam_from_img(points)
    valid = np.isfinite(rays).all(axis=1) & np.isfinite(points).all(axis=1)
    rays[~valid] = (0.0, 0.0, 1.0)
    # Fisheyes without distortion need this, too: they return wrong rays for pixels beyond 90 degrees without an error.
    again = np.asarray(camera.img_from_cam(rays), dtype=float)
    with np.errstate(invalid="ignore"):
        valid &= np.abs(again - points).max(axis=1) <= MAX_REPROJECTION_PX
    return normalized(rays), np.asarray(valid)


def undistorted_pixels(camera: "pycolmap.Camera", points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Undistort pixels, to those of a pinhole camera with the same focal lengths and principal point.

    Parameters
    ----------
    camera : pycolmap.Camera
    points : (k, 2) array
        Pixels.

    Returns
    -------
    pixels : (k, 2) array
        NaN where `valid` is False.
    valid : (k,) bool array
        Whether the pixel has a ray, at most `MAX_ANGLE_DEG` from the optical axis: beyond, undistortion amplifies
        noise.
    """
    points = np.asarray(points, dtype=float)
    if camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE"):
        return points, np.asarray(np.isfinite(points).all(axis=1))
    rays, valid = bearings_of_keypoints(camera, points)
    valid &= rays[:, 2] > np.cos(np.radians(MAX_ANGLE_DEG))
    pixels = np.full_like(points, np.nan)
    K = calibration_matrix(camera)
    pixels[valid] = rays[valid, :2] / rays[valid, 2:] * np.diag(K)[:2] + K[:2, 2]
    return pixels, np.asarray(valid)


def calibration_matrix(camera: "pycolmap.Camera", focal_scale: float = 1.0) -> Array:
    """Calibration matrix (3, 3) with the focal lengths multiplied by a factor.

    That of a spherical camera is the pinhole camera's that touches the sphere at the middle of the image.
    """
    if camera.is_spherical():
        f = focal_length(camera)
        return np.array([[f, 0.0, 0.5 * camera.width], [0.0, f, 0.5 * camera.height], [0.0, 0.0, 1.0]])
    K = np.array(camera.calibration_matrix(), dtype=float)
    K[0, 0] *= focal_scale
    K[1, 1] *= focal_scale
    return K


def with_focal_scale(camera: "pycolmap.Camera", scale: float) -> "pycolmap.Camera":
    """Copy a camera with its focal lengths multiplied and the same distortion in pixels.

    In models whose distortion is a polynomial of the normalised radius, which is inversely proportional to the focal
    length, the coefficient of the 2k-th power is multiplied by ``scale^2k``.
    """
    copy = pycolmap.Camera(camera.todict())
    params = np.array(copy.params, dtype=float)
    params[list(copy.focal_length_idxs())] *= scale
    powers = _RADIAL_POWERS.get(copy.model_name, ())
    for index, power in powers:
        params[index] *= scale**power
    copy.params = params.tolist()
    return copy


def has_radial_term(camera: "pycolmap.Camera") -> bool:
    """Whether the camera's model has a radial term: the polynomials of the normalised radius, and FOV."""
    return camera.model_name in _DISTORTED_BY_POLYNOMIAL or camera.model_name == "FOV"


def is_bent_by_focal(camera: "pycolmap.Camera") -> bool:
    """Whether undistorted pixels depend on the focal length: those of fisheyes do, however small their distortion."""
    return camera.model_name in FISHEYES


def is_undistorted(camera: "pycolmap.Camera") -> bool:
    """Whether a camera whose model has a radial term has no distortion; COLMAP's initial FOV camera counts as such."""
    largest = max((abs(camera.params[k]) for k in camera.extra_params_idxs()), default=0.0)
    return largest <= (MIN_FOV_ANGLE if camera.model_name == "FOV" else 0.0)


def with_radial_term(camera: "pycolmap.Camera", term: float) -> "pycolmap.Camera":
    """Copy a camera and add a radial term to its distortion.

    The result is exact for a polynomial without distortion, and correct to first order otherwise.

    Parameters
    ----------
    camera : pycolmap.Camera
        Of a model with a radial term, see :func:`has_radial_term`.
    term : float
        Of COLMAP's polynomial in normalised coordinates, dimensionless. FOV has barrel distortion only: what would make
        its distortion positive is dropped.
    """
    copy = pycolmap.Camera(camera.todict())
    params = np.array(copy.params, dtype=float)
    if copy.model_name == "FOV":
        # atan(2 r tan(w / 2)) / w is slope * r * (1 - (2 tan(w / 2) r)^2 / 3 + ...), the slope 2 tan(w / 2) / w.
        bent = 2.0 * np.tan(0.5 * max(abs(params[4]), MIN_FOV_ANGLE))
        slope = bent / max(abs(params[4]), MIN_FOV_ANGLE)
        bent = np.sqrt(max(bent**2 - 3.0 * term, MIN_FOV_ANGLE**2))
        params[4] = 2.0 * np.arctan(0.5 * bent)
        params[:2] *= slope / (bent / params[4])
    else:
        params[_RADIAL_POWERS[copy.model_name][0][0]] += term
    copy.params = params.tolist()
    return copy


FISHEYES = {name: int(model) for name, model in pycolmap.CameraModelId.__members__.items() if "FISHEYE" in name}
"""Numbers of COLMAP's fisheye models by their names."""
MIN_FOV_ANGLE = 0.01
"""Parameter of COLMAP's FOV camera without distortion, radians."""
_DISTORTED_BY_POLYNOMIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")

_RADIAL_POWERS: dict[str, tuple[tuple[int, int], ...]] = {
    "SIMPLE_RADIAL": ((3, 2),),
    "RADIAL": ((3, 2), (4, 4)),
    "SIMPLE_DIVISION": ((3, 2),),
    "DIVISION": ((4, 2),),
    "OPENCV": ((4, 2), (5, 4), (6, 1), (7, 1)),
    "FULL_OPENCV": ((4, 2), (5, 4), (6, 1), (7, 1), (8, 6), (9, 2), (10, 4), (11, 6)),
}
"""For each camera model, the index of each distortion parameter and the power of the normalised radius that it is the
coefficient of; tangential terms are of first order."""
