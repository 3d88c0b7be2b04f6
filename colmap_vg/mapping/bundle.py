"""One round of bundle adjustment, with a robust loss that suits the residuals of the job.

Only tracks of three views or more adjust the cameras, since tracks of two views do not determine a pose and bias it.
Points of two views are refined afterwards with the cameras fixed.
"""

from collections.abc import Sequence

import numpy as np
import pycolmap
import pycolmap.pyceres  # the type of a bundle adjustment's summary

from colmap_vg.geometry.directions import normalized
from colmap_vg.mapping.observations import Observations, keypoint_sigma, loss_scale
from colmap_vg.mapping.options import MIN_TRACK_LENGTH, bundle_options
from colmap_vg.mapping.point_refinement import refine_points
from colmap_vg.options import MappingOptions


def adjust_bundle(
    reconstruction: "pycolmap.Reconstruction",
    options: MappingOptions,
    *,
    trial: bool = False,
    priors: Sequence["pycolmap.PosePrior"] = (),
) -> float:
    """Adjust cameras and points, in place.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    options : MappingOptions
    trial : bool
        Only the cost is asked for: the adjustment ends early.
    priors : sequence of pycolmap.PosePrior, optional
        Positions of three images or more in the frame of the reconstruction, with covariances in its unit; they fix
        the gauge.

    Returns
    -------
    float
        Ratio of the final to the initial cost; 1 without observations.
    """
    scale = loss_scale(reconstruction, MIN_TRACK_LENGTH)
    bundle = bundle_options(options, loss_scale_px=scale, trial=trial)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    if priors:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            bundle,
            pycolmap.PosePriorBundleAdjustmentOptions(),
            config,
            _weighted(priors, reconstruction),
            reconstruction,
        )
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(bundle, config, reconstruction)
    summary = adjuster.solve()
    _move_short_tracks(reconstruction, scale)
    # Without observations pycolmap returns no Ceres summary.
    costs = getattr(summary, "ceres_summary", None)
    return float(costs.final_cost / costs.initial_cost) if costs is not None and costs.initial_cost > 0 else 1.0


def _weighted(
    priors: Sequence["pycolmap.PosePrior"], reconstruction: "pycolmap.Reconstruction"
) -> list["pycolmap.PosePrior"]:
    """Priors with covariances relative to those of keypoints, which COLMAP takes to be one pixel squared."""
    variance = keypoint_sigma(reconstruction, MIN_TRACK_LENGTH) ** 2
    copies = [pycolmap.PosePrior(prior.todict()) for prior in priors]
    for copy in copies:
        copy.position_covariance = np.asarray(copy.position_covariance) / variance
    return copies


def _move_short_tracks(reconstruction: "pycolmap.Reconstruction", scale_px: float) -> None:
    """Refine the points whose tracks were too short to adjust the cameras, with the cameras fixed."""
    short = [(i, p) for i, p in sorted(reconstruction.points3D.items()) if p.track.length() < MIN_TRACK_LENGTH]
    if not short:
        return
    seen = Observations.of(reconstruction, [p for _, p in short])
    rays, focal = np.zeros((len(seen.keypoints), 3)), np.zeros(len(seen.keypoints))
    camera_ids = seen.camera_ids
    for camera_id in np.unique(camera_ids).tolist():
        camera, own = reconstruction.camera(camera_id), camera_ids == camera_id
        # Keypoints that cannot be undistorted have NaN rays; their points do not move.
        at = np.concatenate([camera.cam_from_img(seen.keypoints[own]), np.ones((own.sum(), 1))], axis=1)
        rays[own], focal[own] = normalized(at), camera.mean_focal_length()
    moved = refine_points(
        seen.positions,
        seen.point_row,
        np.einsum("kba,kb->ka", seen.rotations[seen.image_row], rays),
        seen.centers[seen.image_row],
        focal,
        scale_px=scale_px,
    )
    for (_, point), position in zip(short, moved, strict=True):
        point.xyz = position
