"""One round of bundle adjustment, with a robust loss scaled to the keypoint noise of the images.

Only tracks of three views or more adjust the cameras, since tracks of two views do not determine a pose and bias it.
Points of two views are refined afterwards with the cameras fixed.
"""

import numpy as np
import pycolmap
import pycolmap.pyceres  # the type of a bundle adjustment's summary

from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY
from colmap_vg.mapping.options import MIN_TRACK_LENGTH, bundle_options
from colmap_vg.mapping.point_refinement import refine_points
from colmap_vg.options import MappingOptions

RAYLEIGH_MEAN, MIN_SIGMA_PX, MAX_SCALE_PX = 1.2533, 0.1, 1.0
"""Mean norm of a 2-vector of standard normal deviates, dimensionless; minimum keypoint noise, pixels; maximum scale of
the loss, pixels."""


def adjust_bundle(
    reconstruction: "pycolmap.Reconstruction",
    options: MappingOptions,
    *,
    max_num_iterations: int,
    function_tolerance: float,
) -> float:
    """Adjust cameras and points, in place.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    options : MappingOptions
    max_num_iterations : int
    function_tolerance : float
        Relative change of the cost at which the solver stops.

    Returns
    -------
    float
        Ratio of the final to the initial cost; 1 without observations.
    """
    scale = _loss_scale(reconstruction)
    bundle = bundle_options(
        options,
        loss_scale_px=scale,
        max_num_iterations=max_num_iterations,
        function_tolerance=function_tolerance,
    )
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(bundle, config, reconstruction).solve()
    _move_short_tracks(reconstruction, scale)
    # Without observations pycolmap returns no Ceres summary.
    costs = getattr(summary, "ceres_summary", None)
    return float(costs.final_cost / costs.initial_cost) if costs is not None and costs.initial_cost > 0 else 1.0


def _loss_scale(reconstruction: "pycolmap.Reconstruction") -> float:
    """Cauchy scale from the median reprojection error, pixels.

    A scale of 1 pixel is too large for sharp photographs: half a pixel lowered their cameras' errors by up to a fifth.
    Errors above 1 pixel come from poor initial poses, not from keypoint noise.
    """
    reconstruction.update_point_3d_errors()
    errors = np.array([point.error for point in reconstruction.points3D.values()])
    sigma = float(np.median(errors)) / RAYLEIGH_MEAN if len(errors) else 0.0
    return min(EFFICIENT_CAUCHY * max(sigma, MIN_SIGMA_PX), MAX_SCALE_PX)


def _move_short_tracks(reconstruction: "pycolmap.Reconstruction", scale_px: float) -> None:
    """Refine the points whose tracks were too short to adjust the cameras, with the cameras fixed."""
    short = [(i, p) for i, p in sorted(reconstruction.points3D.items()) if p.track.length() < MIN_TRACK_LENGTH]
    if not short:
        return
    elements = [(row, e.image_id, e.point2D_idx) for row, (_, p) in enumerate(short) for e in p.track.elements]
    point_row, image_of, _ = np.array(elements, dtype=np.int64).T
    keypoints = np.array([reconstruction.image(i).point2D(k).xy for _, i, k in elements])
    image_ids, image_row = np.unique(image_of, return_inverse=True)
    images = [reconstruction.image(i) for i in image_ids.tolist()]
    camera_ids = np.array([image.camera_id for image in images])[image_row]
    rays, focal = np.zeros((len(elements), 3)), np.zeros(len(elements))
    for camera_id in np.unique(camera_ids).tolist():
        camera, own = reconstruction.camera(camera_id), camera_ids == camera_id
        # Keypoints that cannot be undistorted have NaN rays; their points do not move.
        rays[own] = normalized(np.concatenate([camera.cam_from_img(keypoints[own]), np.ones((own.sum(), 1))], axis=1))
        focal[own] = camera.mean_focal_length()
    world_from_cam = np.array([image.cam_from_world().rotation.matrix().T for image in images])
    centers = np.array([image.projection_center() for image in images])
    moved = refine_points(
        np.array([p.xyz for _, p in short]),
        point_row,
        np.einsum("kab,kb->ka", world_from_cam[image_row], rays),
        centers[image_row],
        focal,
        scale_px=scale_px,
    )
    for (_, point), position in zip(short, moved, strict=True):
        point.xyz = position
