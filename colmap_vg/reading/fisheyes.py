"""Estimate the focal length of fisheye cameras before any relative pose is estimated.

The pixels of a fisheye are undistorted with its focal length. Under a wrong one they are those of no pinhole camera, so
their fundamental matrices vote for a focal length between the wrong one and the right one. Only the right one is voted
for by its own pixels: as the assumed focal length grows, the ratio of the vote to it falls through one there. It is
bracketed on a grid, then found by false position.

COLMAP verifies no pair of fisheyes without a focal length. Their matches before verification are used.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.calibration.focal import vote_focal_lengths
from colmap_vg.colmap_io.cameras import calibration_matrix, is_bent_by_focal, undistorted_pixels, with_focal_scale
from colmap_vg.colmap_io.raw_matches import with_raw_matches, with_unverified_pairs
from colmap_vg.colmap_io.tables import CALIBRATED, UNCALIBRATED, UNDEFINED, DatabaseTables
from colmap_vg.errors import DatabaseError
from colmap_vg.events import report_progress
from colmap_vg.options import ReadOptions
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances
from colmap_vg.two_view.segments import evenly_thinned, rows_of_segments, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

FOCALS_OVER_SIZE = np.geomspace(0.25, 2.0, 10)
"""Focal lengths that are tried, over the longer image side: half angles of 115 to 14 degrees along it."""
MAX_PAIRS, PAIRS_PER_IMAGE, MAX_MATCHES, MIN_MATCHES = 120, 12, 200, 16
"""Maximum number of pairs, of pairs per image, and of matches per pair; minimum number of matches per pair."""
RANSAC = pycolmap.RANSACOptions(max_error=4.0, min_num_trials=30, max_num_trials=1000, random_seed=0)
"""Of matches that COLMAP did not verify, by fundamental matrices of distorted pixels: nine in ten true ones agree."""
MAX_EFFECTIVE_MATCHES = 100.0
"""Of a pair, see `fundamental_covariances`."""
TOLERANCE = 0.05
"""Relative difference between a focal length and its vote up to which it is kept: bundle adjustment finds the rest."""
MIN_SHARE, MIN_GAIN = 0.25, 1.2
"""Minimum share of the pairs that support the focal length found, and its minimum ratio to that of the former one: in
simulated rooms, of lenses that see 30 to 80 degrees off the axis, 0.44 to 1, and 1.4 to 80 times the former share."""
MIN_SHARE_OF_UNKNOWN = 0.05
"""Minimum share where no focal length is given and COLMAP's guess would be used."""
CONVERGED, MAX_NUM_STEPS = 0.005, 6
"""Logarithm of the ratio at which the search ends; maximum number of its steps."""


@dataclass(frozen=True)
class _Vote:
    """Logarithm of the vote over the focal length assumed, NaN without a minimum, and the share of supporting pairs."""

    log_ratio: float
    share: float


def with_found_fisheye_focals(
    tables: DatabaseTables,
    database_path: str | PathLike[str],
    options: ReadOptions,
    calibrated: BoolArray | None = None,
) -> tuple[DatabaseTables, BoolArray]:
    """Replace focal lengths of fisheye cameras that their own pixels do not vote for.

    Parameters
    ----------
    tables : DatabaseTables
    database_path : path
    options : ReadOptions
        With `trust_focal_lengths` "always" nothing is replaced.
    calibrated : (c,) bool array, optional
        Cameras that keep their focal length in any case.

    Returns
    -------
    tables : DatabaseTables
        With other cameras, without a prior focal length; their pairs have no matrices, and their matches before
        verification if the database holds them.
    changed : (c,) bool array
        Cameras whose focal length was replaced.

    Raises
    ------
    DatabaseError
        No pair is verified, and no focal length was found.
    """
    changed = np.zeros(len(tables.cameras), dtype=bool)
    as_read, unknown = tables, np.array([_is_unknown(c) for c in tables.cameras], dtype=bool)
    if unknown.any():
        tables = with_unverified_pairs(tables, database_path, unknown[tables.camera_idx], MIN_MATCHES)
    kinds: dict[object, list[int]] = {}
    for row, camera in enumerate(tables.cameras):
        if is_bent_by_focal(camera) and (calibrated is None or not calibrated[row]):
            kinds.setdefault((camera.model_name, camera.width, camera.height, tuple(camera.params)), []).append(row)
    cameras, caveats = list(tables.cameras), []
    for rows in kinds.values() if options.trust_focal_lengths != "always" else ():
        camera = tables.cameras[rows[0]]
        vote = _vote_of(tables, camera, np.isin(tables.camera_idx, rows), options)
        found = None if vote is None else _found_focal(camera, vote)
        if found is None:
            continue
        scale, before, after = found
        for row in rows:
            cameras[row] = with_focal_scale(tables.cameras[row], scale)
            cameras[row].has_prior_focal_length = False
        changed[rows] = True
        others = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        caveats.append(
            f"Camera {camera.camera_id}{others}: {after:.0%} of the image pairs support a focal length of"
            f" {cameras[rows[0]].mean_focal_length():.1f} px, and {before:.0%} the {camera.mean_focal_length():.1f} px"
            " of the database. It is the initial focal length, and the pairs are verified again with it."
        )
    if not caveats:
        if unknown.any() and not len(as_read.pairs):
            raise DatabaseError(
                f"{database_path}: COLMAP verifies no pair of fisheye cameras without a focal length, and the matches"
                " do not determine it; give the cameras their focal length, and verify the matches again"
            )
        return as_read, changed
    replaced = replace(tables, cameras=tuple(cameras), caveats=(*tables.caveats, *caveats))
    of_changed = np.asarray(changed[tables.camera_idx[tables.pairs]].any(axis=1))
    return with_raw_matches(replaced, database_path, of_changed), changed


def _is_unknown(camera: "pycolmap.Camera") -> bool:
    """Whether COLMAP verifies no pair of a camera: of fisheyes it does not without a focal length."""
    return is_bent_by_focal(camera) and not camera.has_prior_focal_length


def _found_focal(camera: "pycolmap.Camera", vote: Callable[[float], _Vote]) -> tuple[float, float, float] | None:
    """Factor on the focal length, and shares of pairs that support it before and after; None if it is to be kept."""
    given = vote(1.0)
    if camera.has_prior_focal_length and abs(given.log_ratio) <= np.log1p(TOLERANCE) and given.share >= MIN_SHARE:
        return None
    logs = np.log(FOCALS_OVER_SIZE * max(camera.width, camera.height) / camera.mean_focal_length())
    votes = [vote(float(np.exp(log))) for log in logs]
    falls = [k for k in range(len(logs) - 1) if votes[k].log_ratio >= -CONVERGED > votes[k + 1].log_ratio]
    if not falls:
        return None
    # Distortion shifts the place of most support from that of the fall by up to a fifth.
    shares = [max(each.share for each in votes[max(k - 1, 0) : k + 3]) for k in falls]
    k, share = falls[int(np.argmax(shares))], max(shares)
    low, high = (float(logs[k]), max(votes[k].log_ratio, 0.0)), (float(logs[k + 1]), votes[k + 1].log_ratio)
    for _ in range(MAX_NUM_STEPS):
        at = low[0] + (high[0] - low[0]) * low[1] / (low[1] - high[1])
        found = vote(float(np.exp(at)))
        share = max(share, found.share)
        if not abs(found.log_ratio) > CONVERGED:
            break
        low, high = ((at, found.log_ratio), high) if found.log_ratio > 0.0 else (low, (at, found.log_ratio))
    needed = max(MIN_SHARE, MIN_GAIN * given.share) if camera.has_prior_focal_length else MIN_SHARE_OF_UNKNOWN
    if share < needed:
        return None
    return float(np.exp(at)), given.share, share


def _vote_of(
    tables: DatabaseTables, camera: "pycolmap.Camera", images: BoolArray, options: ReadOptions
) -> Callable[[float], _Vote] | None:
    """Function of a factor on the focal length of marked images (n,) that returns its vote; None without pairs."""
    chosen = _sampled_pairs(tables, images, options)
    if not len(chosen):
        return None
    rows, offsets = rows_of_segments(tables.offsets, chosen)
    thin = evenly_thinned(offsets, MAX_MATCHES)
    rows, offsets = rows[thin], segment_subset(offsets, thin)
    pixels = np.concatenate(tables.keypoints).astype(np.float64)
    first, second = (pixels[tables.matched_keypoints(rows, chosen, offsets, side)] for side in (0, 1))
    agree = np.ones(len(first), dtype=bool)
    for row in np.flatnonzero(tables.configs[chosen] == UNDEFINED).tolist():
        own = slice(*offsets[row : row + 2].tolist())
        found = pycolmap.estimate_fundamental_matrix(first[own], second[own], RANSAC)
        agree[own] = False if found is None else found["inlier_mask"]
    first, second, offsets = first[agree], second[agree], segment_subset(offsets, agree)
    size = np.array([max(camera.width, camera.height)], dtype=float)

    def vote(scale: float) -> _Vote:
        report_progress("focal lengths")
        lens = with_focal_scale(camera, scale)
        (points1, valid1), (points2, valid2) = (undistorted_pixels(lens, points) for points in (first, second))
        seen = valid1 & valid2
        of_seen = segment_subset(offsets, seen)
        used = np.flatnonzero(np.diff(of_seen) >= MIN_MATCHES)
        if not len(used):
            return _Vote(np.nan, 0.0)
        rows, of_used = rows_of_segments(of_seen, used)
        p1, p2 = points1[seen][rows], points2[seen][rows]
        F = estimate_fundamental_from_inliers(of_used, p1, p2)
        known = fundamental_covariances(of_used, p1, p2, F, max_effective_matches=MAX_EFFECTIVE_MATCHES)
        K = calibration_matrix(lens)
        found = vote_focal_lengths(
            F,
            np.zeros((len(used), 2), dtype=np.int64),
            K[None, :2, 2],
            size,
            covariances=known.covariances,
            aspect_ratios=K[None, 1, 1] / K[0, 0],
        )
        bounded = np.isfinite(found.sigmas[0])
        log_ratio = float(np.log(found.focal_lengths[0] / K[0, 0])) if bounded else np.nan
        return _Vote(log_ratio, float(found.support[0]) / len(chosen))

    return vote


def _sampled_pairs(tables: DatabaseTables, images: BoolArray, options: ReadOptions) -> IntArray:
    """Rows of pairs of marked images (n,), those with most matches, a few per image."""
    num_matches = np.diff(tables.offsets)
    usable = images[tables.pairs].all(axis=1) & np.isin(tables.configs, (CALIBRATED, UNCALIBRATED, UNDEFINED))
    usable &= num_matches >= max(options.min_num_inliers, MIN_MATCHES)
    count = np.zeros(len(tables.image_ids), dtype=int)
    chosen: list[int] = []
    for row in np.flatnonzero(usable)[np.argsort(-num_matches[usable], kind="stable")].tolist():
        if count[tables.pairs[row]].max() < PAIRS_PER_IMAGE and len(chosen) < MAX_PAIRS:
            count[tables.pairs[row]] += 1
            chosen.append(row)
    return np.sort(np.array(chosen, dtype=np.int64))
