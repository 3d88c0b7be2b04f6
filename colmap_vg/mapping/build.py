"""Build a model from given poses: triangulation, robust bundle adjustment, registration of the remaining images.

pycolmap completes tracks, filters points and registers images. The given poses are nearly right, so one short round of
bundle adjustment suffices where a mapper that starts from rough poses needs many.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import focal_length
from colmap_vg.events import StageLog, report_progress
from colmap_vg.mapping.bundle import Held, adjust_bundle, held_of
from colmap_vg.mapping.lenses import bend_undistorted_fov, reset_diverged_lenses, warn_of_stretched
from colmap_vg.mapping.options import (
    MAX_REPROJECTION_PX,
    MIN_TRIANGULATION_ANGLE_DEG,
    mapper_options,
    triangulator_options,
)
from colmap_vg.mapping.pair_agreement import PairRotations, pair_agreement
from colmap_vg.mapping.points import with_triangulated_points
from colmap_vg.mapping.snapshot import TRADING_OFF
from colmap_vg.mapping.support import is_supported, supported_observations
from colmap_vg.options import MappingOptions

MIN_SUPPORTED_OBSERVATIONS = 15
"""Minimum number of observations, of points seen in three views or more, for an image to stay registered: three times
what determines a pose."""

MAX_NUM_ROUNDS = 6
"""Maximum number of rounds of bundle adjustment and retriangulation."""
CONVERGED_COST_RATIO = 0.7
"""Ratio of final to initial cost of a round at or above which it is the last: the remaining cost is noise. Never the
first one, which is rough: it removes the noise of triangulation, after which tracks are longer and the scale of the
loss is known. Ending there cost up to a tenth of the accuracy under normal noise."""
CONVERGED_FOCAL_CHANGE = 0.01
"""Relative change of a focal length in one round above which another round follows, whatever the cost ratio."""
WELL_INITIALIZED_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")
"""Camera models whose intrinsics are nearly right at the start; changes of their focal lengths cause no further round.
The parameters of other models start at 0 and converge slowly. Further rounds of these would only change parameters that
the photographs hardly determine, such as the ratio of two focal lengths."""


@dataclass(frozen=True)
class BuildResult:
    """Contradictions between the built model and the relative poses of its pairs.

    Attributes
    ----------
    misplaced : frozenset of int
        Ids of images that were registered by their points and removed again because their pairs contradict that pose.
    folded : bool
        Whether the model has parts that only points link, while all pairs between them contradict it.
    """

    misplaced: frozenset[int] = frozenset()
    folded: bool = False


def build_model(
    cache: "pycolmap.DatabaseCache",
    reconstruction: "pycolmap.Reconstruction",
    options: MappingOptions,
    log: StageLog,
    others: frozenset[int] = frozenset(),
    pairs: PairRotations | None = None,
) -> tuple["pycolmap.Reconstruction", BuildResult]:
    """Triangulate and adjust a reconstruction of poses, and register the remaining images.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    reconstruction : pycolmap.Reconstruction
        With the poses of the registered images, no points.
    options : MappingOptions
    log : StageLog
    others : frozenset of int
        Ids of images of other models; they are not registered in this one.
    pairs : PairRotations, optional
        Relative rotations to check the model against: images registered by their points are removed again where their
        pairs contradict the pose, and a warning names parts of the finished model that no pair confirms.

    Returns
    -------
    reconstruction : pycolmap.Reconstruction
    result : BuildResult
    """
    if options.ba_refine_extra_params:
        bend_undistorted_fov(reconstruction)
    reconstruction = triangulated(cache, reconstruction, log)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    held = held_of(cache)
    with log.stage("adjust"):
        if not _adjust_to_convergence(mapper, options, held):
            log.warn(f"Bundle adjustment did not converge in {MAX_NUM_ROUNDS} rounds; the model may be bent.")
        log.result(_state(reconstruction))
    with log.stage("register"):
        misplaced = _register_remaining(mapper, options, held, others, pairs, log)
        named = reset_diverged_lenses(
            reconstruction,
            cache,
            options,
            log,
            lambda changed: _adjust(mapper, changed, held),
        )
        _warn_of_unrefined(reconstruction, cache, options, named, log)
        warn_of_stretched(reconstruction, cache, log)
        folded = _warn_of_folds(reconstruction, pairs, log)
    mapper.end_reconstruction(False)
    reconstruction.update_point_3d_errors()
    return reconstruction, BuildResult(frozenset(misplaced), folded)


def triangulated(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", log: StageLog
) -> "pycolmap.Reconstruction":
    """Copy a model of poses with the points of its registered images, as a stage."""
    with log.stage("triangulate"):
        model = with_triangulated_points(cache, reconstruction, log)
        log.result(f"{model.num_points3D()} points")
    return model


def settle_given_poses(mapper: "pycolmap.IncrementalMapper", options: MappingOptions, held: Held) -> None:
    """Fit given poses and newly triangulated points to each other; where poses are held, keep the points that fit."""
    if held.frames:
        mapper.complete_and_merge_tracks(triangulator_options(options))
        _filter(mapper)
    else:
        _adjust_to_convergence(mapper, options, held)


def finish_registration(
    mapper: "pycolmap.IncrementalMapper",
    options: MappingOptions,
    log: StageLog,
    pairs: PairRotations,
    held: Held,
    kept_frames: frozenset[int],
    placed: Mapping[int, "pycolmap.Rigid3d"] | None = None,
) -> BuildResult:
    """Register images by the points of a finished model, and adjust it, as a stage.

    Parameters
    ----------
    mapper : pycolmap.IncrementalMapper
        Of a model with points.
    options : MappingOptions
    log : StageLog
    pairs : PairRotations
        Relative rotations to check the added images against.
    held : Held
        What is not adjusted.
    kept_frames : frozenset of int
        Ids of frames that stay registered in any case.
    placed : mapping of int to pycolmap.Rigid3d, optional
        Poses, rig from world, of frames to register first.
    """
    model, added, misplaced = mapper.reconstruction, set[int](), set[int]()
    with log.stage("register"):
        found = _register_placed(mapper, options, placed or {})
        while True:
            found |= _register_left_out(mapper, options, frozenset(misplaced))
            wrong = _remove_misplaced(mapper, found, pairs)
            misplaced, found = misplaced | wrong, found - wrong
            if not found:
                break
            added |= found
            _complete_new_tracks(mapper, options)
            _adjust(mapper, options, held)
            added -= _remove_unsupported(mapper, kept_frames)
            found = set()
        folded = _warn_of_folds(model, pairs, log)
        log.result(f"{len(added)} images added, {_state(model)}")
    return BuildResult(frozenset(misplaced), folded)


def _adjust_to_convergence(mapper: "pycolmap.IncrementalMapper", options: MappingOptions, held: Held) -> bool:
    """Alternate bundle adjustment and retriangulation; return whether they converged in `MAX_NUM_ROUNDS` rounds."""
    triangulator = triangulator_options(options)
    _adjust(mapper, options, held, rough=True)
    for _ in range(MAX_NUM_ROUNDS):
        report_progress("tracks")
        mapper.complete_and_merge_tracks(triangulator)
        report_progress("tracks")
        mapper.retriangulate(triangulator)
        _filter(mapper)
        before = _focal_lengths(mapper.reconstruction)
        cost_ratio = _adjust(mapper, options, held)
        change = np.abs(_focal_lengths(mapper.reconstruction) / before - 1.0).max(initial=0.0)
        if cost_ratio >= CONVERGED_COST_RATIO and change <= CONVERGED_FOCAL_CHANGE:
            return True
    return False


def _register_remaining(
    mapper: "pycolmap.IncrementalMapper",
    options: MappingOptions,
    held: Held,
    others: frozenset[int],
    pairs: PairRotations | None,
    log: StageLog,
) -> set[int]:
    """Deregister images without support and register images by their points; return the ids of the misplaced ones."""
    removed = _remove_unsupported(mapper)
    # A removed image may be registered again by its points: its pose from the view graph was wrong.
    added = _register_left_out(mapper, options, others)
    removed -= added
    misplaced = _remove_misplaced(mapper, added, pairs)
    added -= misplaced
    if added or removed or misplaced:
        mapper.complete_and_merge_tracks(triangulator_options(options))
        _adjust(mapper, options, held)
        again = _remove_unsupported(mapper)
        removed, added = removed | again, added - again
    log.result(f"{len(added)} images added, {len(removed)} removed")
    return misplaced


def _focal_lengths(reconstruction: "pycolmap.Reconstruction") -> NDArray[np.float64]:
    """Mean focal lengths of the cameras whose model is not in `WELL_INITIALIZED_MODELS`, pixels."""
    lenses = [lens for _, lens in sorted(reconstruction.cameras.items())]
    return np.array([focal_length(lens) for lens in lenses if lens.model_name not in WELL_INITIALIZED_MODELS])


def adjust_once_more(
    cache: "pycolmap.DatabaseCache",
    reconstruction: "pycolmap.Reconstruction",
    options: MappingOptions,
    *,
    rough: bool = False,
    priors: Sequence["pycolmap.PosePrior"] = (),
) -> float:
    """Run one more round of bundle adjustment on a finished model, in place.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    reconstruction : pycolmap.Reconstruction
    options : MappingOptions
    rough : bool
        The adjustment ends early: only the cost is asked for, or another round follows.
    priors : sequence of pycolmap.PosePrior, optional
        See :func:`adjust_bundle`.

    Returns
    -------
    float
        Ratio of the final to the initial cost.
    """
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    share = _adjust(mapper, options, held_of(cache), rough=rough, priors=priors)
    mapper.end_reconstruction(False)
    reconstruction.update_point_3d_errors()
    return share


def _adjust(
    mapper: "pycolmap.IncrementalMapper",
    options: MappingOptions,
    held: Held,
    *,
    rough: bool = False,
    priors: Sequence["pycolmap.PosePrior"] = (),
) -> float:
    """Run one round of bundle adjustment and filter the points; return the ratio of the final to the initial cost."""
    report_progress("bundle adjustment")
    cost_ratio = adjust_bundle(mapper.reconstruction, options, rough=rough, priors=priors, held=held)
    _filter(mapper)
    return cost_ratio


def _filter(mapper: "pycolmap.IncrementalMapper") -> None:
    mapper.observation_manager.filter_observations_with_negative_depth()
    mapper.observation_manager.filter_all_points3D(MAX_REPROJECTION_PX, MIN_TRIANGULATION_ANGLE_DEG)


def _remove_unsupported(mapper: "pycolmap.IncrementalMapper", kept_frames: frozenset[int] = frozenset()) -> set[int]:
    """Deregister frames with too few observations of well-triangulated points, weakest first; return their images."""
    reconstruction = mapper.reconstruction
    removed: set[int] = set()
    while True:
        frames = {i: reconstruction.image(i).frame_id for i in sorted(reconstruction.reg_image_ids())}
        certain = kept_frames | {
            frame_id
            for image_id, frame_id in frames.items()
            if frame_id not in kept_frames
            and is_supported(reconstruction, image_id, MIN_TRIANGULATION_ANGLE_DEG, MIN_SUPPORTED_OBSERVATIONS)
        }
        if certain.issuperset(frames.values()):
            return removed
        support: Counter[int] = Counter()
        counts = supported_observations(reconstruction, MIN_TRIANGULATION_ANGLE_DEG, without_frames=certain)
        for image_id, count in counts.items():
            support[frames[image_id]] += count
        weak = [(count, frame_id) for frame_id, count in support.items() if count < MIN_SUPPORTED_OBSERVATIONS]
        if not weak:
            return removed
        _, frame_id = min(weak)
        removed |= _images_of(reconstruction, frame_id)
        mapper.observation_manager.deregister_frame(frame_id)


def _register_left_out(
    mapper: "pycolmap.IncrementalMapper", options: MappingOptions, never: frozenset[int]
) -> set[int]:
    """Register images by PnP against the points, best first, until none can be added; return their ids."""
    registration, triangulator = mapper_options(options), triangulator_options(options)
    added: set[int] = set()
    while True:
        candidates = [i for i in mapper.find_next_images(registration, False) if i not in never]
        for image_id in candidates:
            report_progress("images that are left")
            if mapper.register_next_image(registration, image_id):
                added |= _triangulate_frame(mapper, triangulator, mapper.reconstruction.image(image_id).frame_id)
                break
        else:
            return added


def _register_placed(
    mapper: "pycolmap.IncrementalMapper", options: MappingOptions, placed: Mapping[int, "pycolmap.Rigid3d"]
) -> set[int]:
    """Register frames with poses that are nearly right; return the ids of their images."""
    triangulator, added = triangulator_options(options), set[int]()
    for frame_id, pose in placed.items():
        mapper.reconstruction.frame(frame_id).rig_from_world = pose
        mapper.observation_manager.register_frame(frame_id)
        added |= _triangulate_frame(mapper, triangulator, frame_id)
    return added


def _triangulate_frame(
    mapper: "pycolmap.IncrementalMapper", triangulator: "pycolmap.IncrementalTriangulatorOptions", frame_id: int
) -> set[int]:
    """Triangulate the points of a frame's images; return the ids of these."""
    together = _images_of(mapper.reconstruction, frame_id)
    for each in sorted(together):
        mapper.triangulate_image(triangulator, each)
    return together


def _complete_new_tracks(mapper: "pycolmap.IncrementalMapper", options: MappingOptions) -> None:
    """Complete and merge the tracks that changed since the mapper began; it knew the others as they are."""
    triangulator = triangulator_options(options)
    mapper.triangulator.complete_tracks(triangulator, mapper.get_modified_points3D())
    mapper.triangulator.merge_tracks(triangulator, mapper.get_modified_points3D())


def _remove_misplaced(mapper: "pycolmap.IncrementalMapper", added: set[int], pairs: PairRotations | None) -> set[int]:
    """Deregister images added by PnP whose pairs contradict their rotation; return their ids."""
    if pairs is None or not added:
        return set()
    contradicted, misplaced = added & pair_agreement(mapper.reconstruction, pairs).contradicted, set()
    for frame_id in sorted({mapper.reconstruction.image(image_id).frame_id for image_id in contradicted}):
        together = _images_of(mapper.reconstruction, frame_id)
        if 2 * len(together & contradicted) > len(together):
            mapper.observation_manager.deregister_frame(frame_id)
            misplaced |= together
    return misplaced


def _images_of(reconstruction: "pycolmap.Reconstruction", frame_id: int) -> set[int]:
    """Ids of the images that a frame's pose places."""
    return {data.id for data in reconstruction.frame(frame_id).image_ids}


def _warn_of_folds(reconstruction: "pycolmap.Reconstruction", pairs: PairRotations | None, log: StageLog) -> bool:
    """Warn of parts and images that their pairs contradict; return whether there are such parts."""
    if pairs is None:
        return False
    found = pair_agreement(reconstruction, pairs)
    for part in found.detached:
        names = sorted(reconstruction.image(i).name for i in part)
        log.warn(
            f"{len(names)} images ({names[0]} to {names[-1]}) are linked to the rest of the model by points only: all"
            " pairs between them contradict its rotations. The model may be folded there."
        )
    if found.contradicted:
        names = sorted(reconstruction.image(i).name for i in found.contradicted)
        log.warn(f"The model's rotations of {len(names)} images contradict their pairs (first: {names[0]}).")
    return len(found.detached) > 0


def _warn_of_unrefined(
    reconstruction: "pycolmap.Reconstruction",
    cache: "pycolmap.DatabaseCache",
    options: MappingOptions,
    named: frozenset[int],
    log: StageLog,
) -> None:
    """Warn of distortion coefficients that were not refined since they ran away, see :func:`adjust_bundle`."""
    if not options.ba_refine_extra_params or reconstruction.num_points3D() == 0:
        return
    used = sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()})
    kept = [
        camera_id
        for camera_id in used
        if camera_id not in named
        and (places := reconstruction.camera(camera_id).extra_params_idxs())
        and reconstruction.camera(camera_id).model_name in TRADING_OFF
        and all(reconstruction.camera(camera_id).params[k] == cache.camera(camera_id).params[k] for k in places)
    ]
    if kept:
        name = reconstruction.camera(kept[0]).model_name
        log.warn(
            f"The images do not determine the distortion coefficients of {len(kept)} {name} cameras (first: {kept[0]});"
            " they are kept at their initial values."
        )


def _state(reconstruction: "pycolmap.Reconstruction") -> str:
    reconstruction.update_point_3d_errors()
    return (
        f"{reconstruction.num_points3D()} points,"
        f" mean reprojection error {np.nan_to_num(reconstruction.compute_mean_reprojection_error()):.2f} px"
    )
