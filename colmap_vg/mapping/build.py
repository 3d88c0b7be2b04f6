"""From poses to a finished model: triangulation, robust bundle adjustment, registration of what was left, colours.

The heavy work is pycolmap's. Poses come in nearly right, so one short round of bundle adjustment does where a mapper
that starts from rough poses needs many.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.events import StageLog
from colmap_vg.mapping.bundle import adjust_bundle
from colmap_vg.mapping.lenses import reset_diverged_lenses
from colmap_vg.mapping.options import (
    MAX_REPROJECTION_PX,
    MIN_TRIANGULATION_ANGLE_DEG,
    mapper_options,
    triangulator_options,
)
from colmap_vg.mapping.pair_agreement import PairRotations, pair_agreement
from colmap_vg.mapping.support import supported_observations
from colmap_vg.options import MappingOptions

MIN_SUPPORTED_OBSERVATIONS = 15
"""Observations of points seen in three views or more that an image needs to stay: three times what fixes a pose."""

MAX_NUM_ROUNDS = 6
"""Rounds of adjusting and triangulating anew, at most."""
GOOD_START_COST, SETTLED_COST = 0.5, 0.7
"""A round that leaves this share of its cost or more is the last: what is left then is noise. In the first round the
noise of triangulation goes too; two thirds are left where the poses were good, and a third or less where they were not.
After a good start a second round changed positions by 0.1 to 4 % and never for the better."""
SETTLED_FOCAL = 0.01
"""Relative change of a focal length in a round above which another follows, whatever the cost."""
FOUND_WITH_THE_POSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")
"""Lenses of a focal length and one radial term start well. The others go down a long valley, where these would only
follow what the photographs hardly tell, as the ratio of two focal lengths."""


@dataclass(frozen=True)
class BuildResult:
    """What became of the images while the model was built.

    Attributes
    ----------
    misplaced : frozenset of int
        Ids of images that points would have placed where their pairs contradict it.
    folded : bool
        Whether parts are held together by points alone, against what all pairs between them tell.
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
) -> BuildResult:
    """Triangulate and adjust a reconstruction of poses, in place, and register what is left.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    reconstruction : pycolmap.Reconstruction
        With the poses of the registered images, no points.
    options : MappingOptions
    log : StageLog
    others : frozenset of int
        Ids of images that have a model of their own; they are not registered in this one.
    pairs : PairRotations, optional
        Images that come by their points leave again where their pairs contradict that; parts of the finished model
        that no pair confirms are a warning.

    Returns
    -------
    BuildResult
    """
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    triangulator = triangulator_options(options)
    with log.stage("triangulate"):
        image_ids = sorted(reconstruction.reg_image_ids())
        for count, image_id in enumerate(image_ids, start=1):
            mapper.triangulate_image(triangulator, image_id)
            log.progress(f"{count} of {len(image_ids)} images", count / len(image_ids))
        mapper.complete_and_merge_tracks(triangulator)
        log.result(f"{reconstruction.num_points3D()} points")
    with log.stage("adjust"):
        lenses = _focal_lengths(reconstruction)
        left, enough = _adjust(mapper, options, max_num_iterations=15, function_tolerance=5e-4), GOOD_START_COST
        for _ in range(MAX_NUM_ROUNDS):
            before, lenses = lenses, _focal_lengths(reconstruction)
            mapper.complete_and_merge_tracks(triangulator)
            mapper.retriangulate(triangulator)
            _filter(mapper)
            if left >= enough and np.abs(lenses / before - 1.0).max(initial=0.0) <= SETTLED_FOCAL:
                break
            left, enough = _adjust(mapper, options, max_num_iterations=20, function_tolerance=1e-5), SETTLED_COST
        else:
            log.warn(f"Bundle adjustment still lowered its cost after {MAX_NUM_ROUNDS} rounds; the model may be bent.")
        log.result(_state(reconstruction))
    with log.stage("register"):
        removed = _remove_unsupported(mapper)
        # What left may come back by the points: the graph had it in a wrong place.
        added = _register_left_out(mapper, options, others)
        removed -= added
        misplaced = _remove_misplaced(mapper, added, pairs)
        added -= misplaced
        if added or removed or misplaced:
            mapper.complete_and_merge_tracks(triangulator)
            _adjust(mapper, options, max_num_iterations=20, function_tolerance=1e-4)
            again = _remove_unsupported(mapper)
            removed, added = removed | again, added - again
        log.result(f"{len(added)} images added, {len(removed)} removed")
        reset_diverged_lenses(
            reconstruction,
            cache,
            options,
            log,
            lambda held: _adjust(mapper, held, max_num_iterations=20, function_tolerance=1e-5),
        )
        folded = _warn_of_folds(reconstruction, pairs, log)
    mapper.end_reconstruction(False)
    reconstruction.update_point_3d_errors()
    return BuildResult(frozenset(misplaced), folded)


def _focal_lengths(reconstruction: "pycolmap.Reconstruction") -> NDArray[np.float64]:
    """Mean focal lengths of the cameras that start without some of their parameters, pixels."""
    lenses = [lens for _, lens in sorted(reconstruction.cameras.items())]
    return np.array([lens.mean_focal_length() for lens in lenses if lens.model_name not in FOUND_WITH_THE_POSES])


def adjust_once_more(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", options: MappingOptions
) -> float:
    """One more round of bundle adjustment on a finished model, in place.

    Returns
    -------
    float
        The share of its cost that the round left.
    """
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    share = _adjust(mapper, options, max_num_iterations=20, function_tolerance=1e-4)
    mapper.end_reconstruction(False)
    reconstruction.update_point_3d_errors()
    return share


def _adjust(
    mapper: "pycolmap.IncrementalMapper", options: MappingOptions, *, max_num_iterations: int, function_tolerance: float
) -> float:
    """One round of bundle adjustment, then the filter; the share of its cost that the round left."""
    left = adjust_bundle(
        mapper.reconstruction, options, max_num_iterations=max_num_iterations, function_tolerance=function_tolerance
    )
    _filter(mapper)
    return left


def _filter(mapper: "pycolmap.IncrementalMapper") -> None:
    mapper.observation_manager.filter_observations_with_negative_depth()
    mapper.observation_manager.filter_all_points3D(MAX_REPROJECTION_PX, MIN_TRIANGULATION_ANGLE_DEG)


def _remove_unsupported(mapper: "pycolmap.IncrementalMapper") -> set[int]:
    """Deregister images that too few well-triangulated points fix, weakest first, until all that stay are fixed."""
    reconstruction = mapper.reconstruction
    removed: set[int] = set()
    while True:
        support = supported_observations(reconstruction, MIN_TRIANGULATION_ANGLE_DEG)
        weak = [(count, image_id) for image_id, count in support.items() if count < MIN_SUPPORTED_OBSERVATIONS]
        if not weak:
            return removed
        _, image_id = min(weak)
        mapper.observation_manager.deregister_frame(reconstruction.image(image_id).frame_id)
        removed.add(image_id)


def _register_left_out(
    mapper: "pycolmap.IncrementalMapper", options: MappingOptions, never: frozenset[int]
) -> set[int]:
    """Register images by PnP against the points, best first, until no more can be."""
    registration, triangulator = mapper_options(options), triangulator_options(options)
    added: set[int] = set()
    while True:
        candidates = [i for i in mapper.find_next_images(registration, False) if i not in never]
        for image_id in candidates:
            if mapper.register_next_image(registration, image_id):
                mapper.triangulate_image(triangulator, image_id)
                added.add(image_id)
                break
        else:
            return added


def _remove_misplaced(mapper: "pycolmap.IncrementalMapper", added: set[int], pairs: PairRotations | None) -> set[int]:
    """Deregister those of the images that came by their points whose pairs tell another rotation."""
    if pairs is None or not added:
        return set()
    misplaced = added & pair_agreement(mapper.reconstruction, pairs).contradicted
    for image_id in sorted(misplaced):
        mapper.observation_manager.deregister_frame(mapper.reconstruction.image(image_id).frame_id)
    return misplaced


def _warn_of_folds(reconstruction: "pycolmap.Reconstruction", pairs: PairRotations | None, log: StageLog) -> bool:
    """Warn of parts and images that their pairs contradict; whether there are such parts."""
    if pairs is None:
        return False
    found = pair_agreement(reconstruction, pairs)
    for part in found.detached:
        names = sorted(reconstruction.image(i).name for i in part)
        log.warn(
            f"{len(names)} images ({names[0]} to {names[-1]}) are held to the rest of the model by points alone: all"
            " pairs between them tell other rotations. The model may be folded there."
        )
    if found.contradicted:
        names = sorted(reconstruction.image(i).name for i in found.contradicted)
        log.warn(f"The pairs of {len(names)} images tell other rotations than the model (first: {names[0]}).")
    return len(found.detached) > 0


def _state(reconstruction: "pycolmap.Reconstruction") -> str:
    reconstruction.update_point_3d_errors()
    return (
        f"{reconstruction.num_points3D()} points,"
        f" mean reprojection error {np.nan_to_num(reconstruction.compute_mean_reprojection_error()):.2f} px"
    )
