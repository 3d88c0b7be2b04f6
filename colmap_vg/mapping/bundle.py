"""One round of bundle adjustment, with a robust loss that suits the residuals of the job.

Ceres adjusts rigs, and models that measured positions or kept poses hold; the others take a third of its time here.
Only tracks of three views or more adjust the cameras, since tracks of two views do not determine a pose and bias it.
Points of two views are refined afterwards with the cameras fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pycolmap.pyceres  # the type of a bundle adjustment's summary

from colmap_vg.bundle.adjustment import ROUGH_TOLERANCE, TOLERANCE, adjust
from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length
from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.mapping.bundle_problem import ModelProblem, has_rigs
from colmap_vg.mapping.observations import Observations, keypoint_sigma, loss_scale
from colmap_vg.mapping.options import MIN_TRACK_LENGTH, bundle_options
from colmap_vg.mapping.point_refinement import refine_points
from colmap_vg.mapping.snapshot import Snapshot
from colmap_vg.options import MappingOptions


@dataclass(frozen=True)
class Held:
    """What bundle adjustment leaves as it is.

    Attributes
    ----------
    sensors : sequence of pycolmap.sensor_t
        Sensors whose place in their rig is kept; distances between them fix the scale.
    frames : frozenset of int
        Ids of frames whose poses are kept, with the calibrations of their cameras.
    """

    sensors: Sequence["pycolmap.sensor_t"] = ()
    frames: frozenset[int] = frozenset()


NOTHING_HELD = Held()


def held_of(of: "pycolmap.DatabaseCache | pycolmap.Reconstruction", frames: frozenset[int] = frozenset()) -> Held:
    """Hold the sensors whose place in their rig a database or a model knows, and some frames."""
    rigs = [rig for _, rig in sorted(of.rigs.items())]
    sensors = [sensor for rig in rigs for sensor in rig.non_ref_sensors if rig.has_sensor_from_rig(sensor)]
    return Held(sensors, frames)


def adjust_bundle(
    reconstruction: "pycolmap.Reconstruction",
    options: MappingOptions,
    *,
    rough: bool = False,
    priors: Sequence["pycolmap.PosePrior"] = (),
    held: Held = NOTHING_HELD,
) -> float:
    """Adjust cameras and points, in place.

    Where Ceres lets distortion coefficients run away so far that points lose their projections, they are not refined.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    options : MappingOptions
    rough : bool
        The adjustment ends early: only the cost is asked for, or another round follows.
    priors : sequence of pycolmap.PosePrior, optional
        Positions of three images or more in the frame of the reconstruction, with covariances in its unit; they fix
        the gauge.
    held : Held, optional

    Returns
    -------
    float
        Ratio of the final to the initial cost; 1 without observations.
    """
    observed = ModelObservations.of(reconstruction)
    if held.frames:
        images = [reconstruction.image(i) for i in sorted(reconstruction.reg_image_ids())]
        observed = observed.of_points_in([image.image_id for image in images if image.frame_id not in held.frames])
    scale = loss_scale(reconstruction, MIN_TRACK_LENGTH, observed)
    if not priors and not has_rigs(reconstruction):
        ratio = 1.0
        if model := ModelProblem.of(reconstruction, observed, options, MIN_TRACK_LENGTH, held.frames):
            found = adjust(model.problem, model.state, scale, tolerance=ROUGH_TOLERANCE if rough else TOLERANCE)
            model.write(found.state, reconstruction)
            ratio = found.final_cost / found.initial_cost if found.initial_cost > 0.0 else 1.0
        _move_remaining_points(reconstruction, observed, scale, held)
        return ratio
    bundle = bundle_options(options, loss_scale_px=scale, rough=rough)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        if reconstruction.image(image_id).frame_id not in held.frames:
            config.add_image(image_id)
    for sensor in held.sensors:
        config.set_constant_sensor_from_rig_pose(sensor)
    # COLMAP moves no point that cameras outside of the adjustment see, too.
    for frame_id in sorted(held.frames & set(reconstruction.reg_frame_ids())):
        for data in reconstruction.frame(frame_id).image_ids:
            config.set_constant_cam_intrinsics(reconstruction.image(data.id).camera_id)
    if priors:
        of_priors, weighted = pycolmap.PosePriorBundleAdjustmentOptions(), _weighted(priors, reconstruction)
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(bundle, of_priors, config, weighted, reconstruction)
    else:
        if not held.frames and is_metric(reconstruction, held.sensors):
            config.set_constant_rig_from_world_pose(min(reconstruction.reg_frame_ids()))
        elif not held.frames:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(bundle, config, reconstruction)
    before = Snapshot.of(reconstruction) if options.ba_refine_extra_params else None
    summary = adjuster.solve()
    if before is not None and before.is_spoilt(reconstruction):
        before.restore(reconstruction)
        kept = replace(options, ba_refine_extra_params=False)
        return adjust_bundle(reconstruction, kept, rough=rough, priors=priors, held=held)
    _move_remaining_points(reconstruction, observed, scale, held, only_short=not held.frames)
    # Without observations pycolmap returns no Ceres summary.
    costs = getattr(summary, "ceres_summary", None)
    return float(costs.final_cost / costs.initial_cost) if costs is not None and costs.initial_cost > 0 else 1.0


def is_metric(reconstruction: "pycolmap.Reconstruction", sensors: Sequence["pycolmap.sensor_t"]) -> bool:
    """Whether sensors at fixed distances from their rig's origin determine the scale of a model."""
    distances = [
        float(np.linalg.norm(rig.sensor_from_rig(sensor).translation))
        for _, rig in sorted(reconstruction.rigs.items())
        for sensor in sensors
        if rig.has_sensor(sensor)
    ]
    return max(distances, default=0.0) > 0.0


def _weighted(
    priors: Sequence["pycolmap.PosePrior"], reconstruction: "pycolmap.Reconstruction"
) -> list["pycolmap.PosePrior"]:
    """Priors with covariances relative to those of keypoints, which COLMAP takes to be one pixel squared."""
    variance = keypoint_sigma(reconstruction, MIN_TRACK_LENGTH) ** 2
    copies = [pycolmap.PosePrior(prior.todict()) for prior in priors]
    for copy in copies:
        copy.position_covariance = np.asarray(copy.position_covariance) / variance
    return copies


def _move_remaining_points(
    reconstruction: "pycolmap.Reconstruction",
    observed: ModelObservations,
    scale_px: float,
    held: Held,
    *,
    only_short: bool = True,
) -> None:
    """Refine points that did not move with the cameras, with these fixed.

    Their tracks were too short, or Ceres left them since cameras that are held see them, too; not those that these see
    mostly.
    """
    every, row, length = np.unique(observed.point_ids, return_inverse=True, return_counts=True)
    moving = length < (MIN_TRACK_LENGTH if only_short else np.inf)
    if held.frames:
        frames = {i: reconstruction.image(i).frame_id in held.frames for i in np.unique(observed.image_ids).tolist()}
        by_held = np.bincount(row, [frames[i] for i in observed.image_ids.tolist()], len(every))
        moving &= 2.0 * by_held <= length
    point_ids = every[moving]
    if not len(point_ids):
        return
    seen = Observations.of(reconstruction, observed, point_ids)
    rays, focal = np.zeros((len(seen.keypoints), 3)), np.zeros(len(seen.keypoints))
    camera_ids = seen.camera_ids
    for camera_id in np.unique(camera_ids).tolist():
        camera, own = reconstruction.camera(camera_id), camera_ids == camera_id
        found, valid = bearings_of_keypoints(camera, seen.keypoints[own])
        # Points of keypoints without a ray do not move.
        rays[own], focal[own] = np.where(valid[:, None], found, np.nan), focal_length(camera)
    moved = refine_points(
        seen.positions,
        seen.point_row,
        np.einsum("kba,kb->ka", seen.rotations[seen.image_row], rays),
        seen.centers[seen.image_row],
        focal,
        scale_px=scale_px,
    )
    for point_id, position in zip(point_ids.tolist(), moved, strict=True):
        reconstruction.point3D(point_id).xyz = position
