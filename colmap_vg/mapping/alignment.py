"""Align a finished model to known positions of its cameras, or to survey points that its photographs show."""

from collections.abc import Mapping

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length
from colmap_vg.colmap_io.known_positions import SurveyPoint
from colmap_vg.colmap_io.pose_priors import east_north_up
from colmap_vg.errors import MappingError
from colmap_vg.events import StageLog
from colmap_vg.geometry.robust_similarity import align_robustly
from colmap_vg.mapping.georeference import Georeference, described, georeference, move_model, why_not
from colmap_vg.mapping.point_refinement import refine_points
from colmap_vg.options import MappingOptions
from colmap_vg.scene.pose_priors import PosePriors

Array = NDArray[np.float64]

MIN_VIEWS = 2
"""Minimum number of registered images that show a survey point."""


def align_to_positions(
    model: "pycolmap.Reconstruction", positions: Mapping[str, tuple[float, float, float]], by_gps: bool, log: StageLog
) -> Georeference:
    """Move a model to known positions of its cameras, in place.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    positions : mapping of str to (float, float, float)
        By image name: latitude, longitude and height, or Cartesian.
    by_gps : bool
    log : StageLog

    Returns
    -------
    Georeference

    Raises
    ------
    MappingError
        Fewer than three positions are of registered images, or they do not agree with the model.
    """
    ids = {model.image(image_id).name: image_id for image_id in sorted(model.reg_image_ids())}
    known = [(ids[name], position) for name, position in positions.items() if name in ids]
    if len(known) < 3:
        raise MappingError(
            f"{len(known)} of {len(positions)} known positions are of images of the model, by their names; three or"
            " more align it"
        )
    places, origin = np.array([position for _, position in known], dtype=np.float64), None
    if by_gps:
        places, origin = east_north_up(places)
    n = len(known)
    priors = PosePriors(places, np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan), origin)
    image_ids = np.array([image_id for image_id, _ in known], dtype=np.int64)
    found = georeference(None, model, priors, image_ids, MappingOptions(), log)
    if found is None:
        raise MappingError("the known positions do not agree with the model, see the warning")
    return found


def align_to_points(
    model: "pycolmap.Reconstruction", points: Mapping[str, SurveyPoint], by_gps: bool, log: StageLog
) -> Georeference:
    """Move a model to survey points, in place; these are triangulated from their keypoints.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    points : mapping of str to SurveyPoint
        By name.
    by_gps : bool
        Whether positions are latitude, longitude and height.
    log : StageLog

    Returns
    -------
    Georeference
        Residuals and outliers are those of points.

    Raises
    ------
    MappingError
        Fewer than three points are seen by two registered images, or they do not agree with the model.
    """
    found = {name: place for name, point in points.items() if (place := _triangulated(model, point)) is not None}
    if len(found) < 3:
        raise MappingError(
            f"{len(found)} of {len(points)} survey points are shown by two images of the model or more; three align it"
        )
    truth, origin = np.array([points[name].position for name in found], dtype=np.float64), None
    if by_gps:
        truth, origin = east_north_up(truth)
    estimated = np.array(list(found.values()))
    aligned = align_robustly(estimated, truth)
    problem = why_not(aligned)
    if problem or aligned.roll_is_free:
        raise MappingError(f"the survey points do not align the model: {problem or 'they lie on a line'}")
    move_model(model, aligned.similarity)
    residuals = truth - aligned.similarity.apply(estimated)
    return described(list(found), residuals, aligned, origin, False, log)


def _triangulated(model: "pycolmap.Reconstruction", point: SurveyPoint) -> Array | None:
    """Position of a point in the model's frame; None where fewer than two registered images show it."""
    ids = {model.image(image_id).name: image_id for image_id in model.reg_image_ids()}
    rays, centers, focals = [], [], []
    for name, pixel in point.keypoints:
        if name not in ids:
            continue
        image = model.image(ids[name])
        camera = model.camera(image.camera_id)
        ray, valid = bearings_of_keypoints(camera, np.array([pixel]))
        if valid[0]:
            rays.append(image.cam_from_world().rotation.matrix().T @ ray[0])
            centers.append(image.projection_center())
            focals.append(focal_length(camera))
    if len(rays) < MIN_VIEWS:
        return None
    u, c = np.array(rays), np.array(centers)
    # Nearest to all rays: sum (I - u u^T) (x - c) = 0; then by reprojection errors.
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    start = np.linalg.lstsq(across.sum(axis=0), np.einsum("kab,kb->a", across, c), rcond=None)[0]
    row = np.zeros(len(u), dtype=np.int64)
    return np.asarray(refine_points(start[None], row, u, c, np.array(focals), scale_px=4.0, num_iterations=10)[0])
