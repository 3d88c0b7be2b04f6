"""Decide whether the focal lengths of a database can be trusted, and estimate those that cannot.

The configurations in the database do not decide it: with a prior, COLMAP verifies pairs by essential matrices and
labels them CALIBRATED even if the focal length is 15 % off; without one, nearly every pair is UNCALIBRATED, and so are
false pairs under a correct focal length. The matches decide it: each pair's fundamental matrix votes for the focal
lengths that make it essential.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_vg.calibration.self_calibration import SelfCalibration, estimate_focal_lengths
from colmap_vg.colmap_io.cameras import calibration_matrix
from colmap_vg.colmap_io.tables import CALIBRATED, PANORAMIC, PLANAR, PLANAR_OR_PANORAMIC, UNCALIBRATED, DatabaseTables
from colmap_vg.colmap_io.undistortion import undistorted_keypoints
from colmap_vg.options import ReadOptions
from colmap_vg.two_view.segments import evenly_thinned, rows_of_segments, segment_subset

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

ALIKE = 0.03
"""Relative difference of focal lengths below which two votes count as equal; lenses that differ by less may be merged
without harm."""
MAX_PAIRS_PER_CAMERA = 400
"""Maximum number of pairs that vote for a camera, those with most matches."""
MIN_MATCHES_PER_VOTE = 16
"""Minimum number of matches of a pair that votes."""
MAX_MATCHES_PER_VOTE = 300
"""Maximum number of a pair's matches that its vote uses, sampled evenly from its list; more change the vote by less
than its own error."""


@dataclass(frozen=True, eq=False)
class FocalDecision:
    """Focal lengths to read a database with.

    Attributes
    ----------
    scales : (c,) array
        Factor on each camera's focal length in the database, dimensionless.
    known : (c,) bool array
        Whether the focal length was given and is not contradicted.
    caveats : tuple of str
        Sentences on what was changed or could not be decided.
    """

    scales: Array
    known: BoolArray
    caveats: tuple[str, ...]


def decide_focal_lengths(
    tables: DatabaseTables,
    options: ReadOptions,
    calibrated: BoolArray | None = None,
    estimated: BoolArray | None = None,
) -> FocalDecision:
    """Decide for each camera whether its focal length is kept, and by what factor it is changed otherwise.

    Parameters
    ----------
    tables : DatabaseTables
    options : ReadOptions
    calibrated : (c,) bool array, optional
        Cameras that keep their focal length in any case, as those of a given model.
    estimated : (c,) bool array, optional
        Cameras whose focal length was estimated before, and which keep it, though it is not known.

    Returns
    -------
    FocalDecision
    """
    calibrated = np.zeros(len(tables.cameras), dtype=bool) if calibrated is None else calibrated
    estimated = np.zeros(len(tables.cameras), dtype=bool) if estimated is None else estimated
    kept = calibrated | estimated
    if kept.all():
        return FocalDecision(np.ones(len(kept)), ~estimated, ())
    # Spherical cameras have no focal length that could be wrong.
    prior = np.array([c.has_prior_focal_length or c.is_spherical() for c in tables.cameras], dtype=bool)
    as_given = np.ones(len(prior))
    if options.trust_focal_lengths == "always":
        return FocalDecision(as_given, np.ones(len(prior), dtype=bool), _contradictions(tables, options))
    found = _voted(tables, prior, kept, options)
    return replace(found, known=found.known & ~estimated)


def _contradictions(tables: DatabaseTables, options: ReadOptions) -> tuple[str, ...]:
    """Sentences on focal lengths that are kept although image pairs contradict them."""
    focals = _focal_lengths(tables)
    calibration = _self_calibration(tables, focals, np.ones(len(focals), dtype=bool), options)
    if calibration is None:
        return ()
    votes = calibration.by_pairs.estimates
    against = np.flatnonzero(calibration.by_pairs.contradicted)
    if len(against) == 0:
        return ()
    first = against[0]
    others = f" The same holds for {len(against) - 1} more cameras." if len(against) > 1 else ""
    return (
        f"Camera {tables.cameras[first].camera_id}: {votes.support[first]} of {votes.num_pairs[first]} image pairs"
        f" support a focal length of {votes.focal_lengths[first]:.1f} px, not the {focals[first]:.1f} px of the"
        f" database, which is kept as requested.{others}",
    )


def _voted(tables: DatabaseTables, prior: BoolArray, calibrated: BoolArray, options: ReadOptions) -> FocalDecision:
    focals = _focal_lengths(tables)
    spherical = np.array([c.is_spherical() for c in tables.cameras], dtype=bool)
    given = (prior & (options.trust_focal_lengths != "never")) | spherical | calibrated
    calibration = _self_calibration(tables, focals, given, options)
    if calibration is None:
        unchecked = () if spherical.all() else (_why_unchecked(tables, options),)
        return FocalDecision(np.ones(len(focals)), prior, unchecked)
    changed = calibration.found & ~calibrated
    found = np.where(calibrated, focals, calibration.focal_lengths)
    without = ~given & ~calibration.decided
    found = np.where(given, found, _in_common(tables, found, calibration, given))
    scales = found / focals
    caveats = [
        f"Camera {c.camera_id}: the focal length {f:.1f} px of the database is contradicted by its image pairs;"
        f" {s * f:.1f} px is used instead."
        for c, f, s, bad in zip(tables.cameras, focals, scales, changed & prior, strict=True)
        if bad
    ]
    if without.any():
        source = "that of the other cameras is used" if calibration.decided.any() else "COLMAP's guess is used"
        caveats.append(
            f"{int(without.sum())} of {len(focals)} cameras have no focal length, and their pairs do not determine it;"
            f" {source}."
        )
    return FocalDecision(np.asarray(scales, dtype=float), given & ~changed, tuple(caveats))


def _why_unchecked(tables: DatabaseTables, options: ReadOptions) -> str:
    """Warning for a database in which no pair can vote."""
    enough = np.diff(tables.offsets) >= max(options.min_num_inliers, MIN_MATCHES_PER_VOTE)
    flat = np.isin(tables.configs, (PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC))
    if (enough & flat).any():
        why = f"in {int((enough & flat).sum())} pairs all matches lie on one plane, or the camera only rotated"
    elif enough.any():
        why = "COLMAP found no geometry for the pairs that have enough matches"
    else:
        why = f"no pair has the required {max(options.min_num_inliers, MIN_MATCHES_PER_VOTE)} matches"
    return f"The focal lengths cannot be checked, and those of the database are used: {why}."


def _in_common(tables: DatabaseTables, found: Array, calibration: SelfCalibration, given: BoolArray) -> Array:
    """Share one focal length among cameras of one model and size without a given one, unless their pairs contradict it.

    Most such sets of images were taken with one lens. Cameras whose pairs determine none get that of the others.
    """
    decided, sigmas = calibration.decided & ~given, calibration.by_pairs.estimates.sigmas
    size = np.array([max(c.width, c.height) for c in tables.cameras], dtype=float)
    anywhere = np.log(np.median((found / size)[calibration.decided])) if calibration.decided.any() else None
    groups, result = _lens_groups(tables.cameras), found.copy()
    for group in np.unique(groups[~given]):
        rows = np.flatnonzero((groups == group) & ~given)
        voters = rows[decided[rows]]
        if len(voters) == 0:
            if anywhere is not None:
                result[rows] = np.exp(anywhere) * size[rows]
            continue
        log_ratio = np.log(found[voters] / size[voters])
        common = float(np.median(log_ratio))
        agree = np.abs(log_ratio - common) <= np.maximum(3.0 * np.nan_to_num(sigmas[voters], posinf=0.0), ALIKE)
        if agree.mean() < 0.5:
            continue
        weights = 1.0 / np.square(np.clip(np.nan_to_num(sigmas[voters[agree]], posinf=1.0), 1e-3, 1.0))
        common = float(np.average(log_ratio[agree], weights=weights))
        joined = np.concatenate([voters[agree], rows[~decided[rows]]])
        result[joined] = np.exp(common) * size[joined]
    return result


def _lens_groups(cameras: "Sequence[pycolmap.Camera]") -> IntArray:
    """Number of each camera's model and image size: cameras that share both probably have one lens."""
    kinds: dict[object, int] = {}
    keys = [(camera.model_name, camera.width, camera.height) for camera in cameras]
    return np.array([kinds.setdefault(key, len(kinds)) for key in keys], dtype=np.int64)


def _self_calibration(
    tables: DatabaseTables, focals: Array, given: BoolArray, options: ReadOptions
) -> SelfCalibration | None:
    enough = np.diff(tables.offsets) >= max(options.min_num_inliers, MIN_MATCHES_PER_VOTE)
    chosen = np.flatnonzero(np.isin(tables.configs, (CALIBRATED, UNCALIBRATED)) & enough & ~tables.spherical)
    if len(chosen) == 0:
        return None
    chosen = chosen[_strongest_of_cameras(tables.camera_idx[tables.pairs[chosen]], np.diff(tables.offsets)[chosen])]
    rows, offsets = rows_of_segments(tables.offsets, chosen)
    thin = evenly_thinned(offsets, MAX_MATCHES_PER_VOTE)
    rows, offsets = rows[thin], segment_subset(offsets, thin)
    pixels, valid = undistorted_keypoints(tables)
    first, second = (tables.matched_keypoints(rows, chosen, offsets, side) for side in (0, 1))
    seen = valid[first] & valid[second]
    points1, points2, offsets = pixels[first[seen]], pixels[second[seen]], segment_subset(offsets, seen)
    if np.diff(offsets).max(initial=0) < MIN_MATCHES_PER_VOTE:
        return None
    return estimate_focal_lengths(
        tables.pairs[chosen],
        tables.camera_idx,
        offsets,
        points1,
        points2,
        focals,
        np.array([calibration_matrix(c)[:2, 2] for c in tables.cameras]),
        np.array([[c.width, c.height] for c in tables.cameras], dtype=float),
        given=given,
        lens_groups=_lens_groups(tables.cameras),
        aspect_ratios=np.array([K[1, 1] / K[0, 0] for K in map(calibration_matrix, tables.cameras)]),
    )


def _focal_lengths(tables: DatabaseTables) -> Array:
    return np.array([calibration_matrix(camera)[0, 0] for camera in tables.cameras])


def _strongest_of_cameras(cameras: IntArray, num_matches: IntArray) -> BoolArray:
    """Whether each pair is among those with most matches of one of its cameras (m, 2), (m,)."""
    pair = np.tile(np.arange(len(cameras)), 2)
    camera = cameras.T.ravel()
    order = np.lexsort((pair, -num_matches[pair], camera))
    rank = np.arange(len(order)) - np.searchsorted(camera[order], camera[order], side="left")
    kept = np.zeros(len(cameras), dtype=bool)
    kept[pair[order[rank < MAX_PAIRS_PER_CAMERA]]] = True
    return kept
