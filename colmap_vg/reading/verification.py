"""Check that the two-view geometries of a database explain their matches, and estimate new ones for those that do not.

Many tools write databases: matrices may be placeholders, belong to other matches, or be missing, and matches may never
have been verified. A matrix or pose is accepted if the median match of its pair is within COLMAP's threshold, with
keypoints as they are or undistorted. Otherwise the pair's matrices are discarded, and where its matches do not agree
with one fundamental matrix, pycolmap verifies them.
"""

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import calibration_matrix
from colmap_vg.colmap_io.tables import CALIBRATED, DEGENERATE, UNCALIBRATED, UNDEFINED, WATERMARK, DatabaseTables
from colmap_vg.colmap_io.undistortion import undistorted_keypoints
from colmap_vg.events import report_progress
from colmap_vg.geometry import so3
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.sampson_errors import pixel_sampson_errors
from colmap_vg.two_view.segments import (
    evenly_thinned,
    products_of_segments,
    rows_of_segments,
    segment_quantiles,
    segment_subset,
    segment_sums,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_ERROR_PX = 4.0
"""COLMAP's threshold of two-view verification, pixels."""
MIN_SHARE_AGREEING = 0.97
"""Minimum share of a pair's matches within the threshold of one fundamental matrix for them to count as verified."""
MIN_SHARE_OF_INLIERS = 0.5
"""The same where the matches were verified before."""
MAX_MATCHES_CHECKED = 100
"""Maximum number of a pair's matches that check its matrices."""
MIN_NUM_MATCHES, MIN_NUM_REFITTED = 15, 8
"""Minimum number of inliers of a verified pair, as COLMAP's; minimum number of matches to estimate a matrix from."""
FAR = 1e12
"""Distance, pixels, in place of an undefined one: the matrix is missing or degenerate for the match."""


def with_verified_geometries(
    tables: DatabaseTables, seed: int, expected: BoolArray | None = None, of_inliers: BoolArray | None = None
) -> tuple[DatabaseTables, BoolArray]:
    """Replace the two-view geometries that do not explain their matches.

    Parameters
    ----------
    tables : DatabaseTables
    seed : int
        Random seed of the verification.
    expected : (m,) bool array, optional
        Pairs that are known to need new geometries, and for which there is no warning.
    of_inliers : (m,) bool array, optional
        Pairs whose matches were verified before with another lens: they are verified again where most do not agree.

    Returns
    -------
    tables : DatabaseTables
        All matrices explain their matches or are NaN; with a caveat if pairs were changed.
    changed : (m,) bool array
        Whether each pair's configuration or matches may differ from those of the database.
    """
    undistorted, valid = undistorted_keypoints(tables)
    raw = np.concatenate([*tables.keypoints, np.zeros((0, 2))]).astype(np.float64)
    judged = ~np.isin(tables.configs, (DEGENERATE, WATERMARK)) & (np.diff(tables.offsets) >= MIN_NUM_REFITTED)
    judged &= ~tables.spherical
    as_seen = (raw,) if np.array_equal(raw, undistorted) else (raw, undistorted)
    unexplained = np.flatnonzero(judged & ~_explained(tables, as_seen))
    changed = np.zeros(len(tables.pairs), dtype=bool)
    if len(unexplained) == 0:
        return tables, changed
    changed[unexplained] = True
    rows, offsets = rows_of_segments(tables.offsets, unexplained)
    first, second = (tables.matched_keypoints(rows, unexplained, offsets, side) for side in (0, 1))
    seen = valid[first] & valid[second]
    points1, points2, offsets = undistorted[first[seen]], undistorted[second[seen]], segment_subset(offsets, seen)
    F = estimate_fundamental_from_inliers(offsets, points1, points2)
    agree = np.abs(pixel_sampson_errors(F, offsets, points1, points2)) <= MAX_ERROR_PX
    shares = segment_sums(offsets, agree.astype(float)) / np.maximum(np.diff(offsets), 1)
    configs, matrices = tables.configs.copy(), {name: getattr(tables, name).copy() for name in ("E", "F", "H")}
    for matrix in matrices.values():
        matrix[unexplained] = np.nan
    given = np.array([c.has_prior_focal_length for c in tables.cameras], dtype=bool)
    prior = np.asarray(given[tables.camera_idx[tables.pairs]].all(axis=1))
    undefined = configs == UNDEFINED
    configs[undefined] = np.where(prior[undefined], CALIBRATED, UNCALIBRATED)
    # With given focal lengths the pose is estimated from the bearings, otherwise from the fundamental matrix, as where
    # more of the matches may be false.
    guessed = ~prior[unexplained]
    if of_inliers is not None:
        guessed |= of_inliers[unexplained]
    matrices["F"][unexplained[guessed]] = F[guessed]
    rotations, translations = tables.rotations.copy(), tables.translations.copy()
    rotations[unexplained], translations[unexplained] = np.nan, np.nan
    least = np.full(len(shares), MIN_SHARE_AGREEING)
    if of_inliers is not None:
        least[of_inliers[unexplained]] = MIN_SHARE_OF_INLIERS
    doubtful = unexplained[shares < least]
    found = replace(tables, configs=configs, rotations=rotations, translations=translations, **matrices)
    caveat = (
        f"{len(unexplained)} of {len(tables.pairs)} pairs have no matrix that explains their matches; their two-view"
        " geometry is estimated from the matches."
    )
    if len(doubtful):
        before = int(np.diff(tables.offsets)[doubtful].sum())
        found = _verified(found, doubtful, seed)
        after = int(np.diff(found.offsets)[doubtful].sum())
        caveat += (
            f" In {len(doubtful)} of them the matches were not verified: {before - after} of {before} are outliers and"
            " are removed."
        )
    if expected is not None and expected[unexplained].all():
        return found, changed
    return replace(found, caveats=(*tables.caveats, caveat)), changed


def _explained(tables: DatabaseTables, pixels: tuple[Array, ...]) -> BoolArray:
    """Whether the median match of each pair is near one of its matrices, in original or undistorted pixels, (m,)."""
    every = np.arange(len(tables.pairs))
    thin = evenly_thinned(tables.offsets, MAX_MATCHES_CHECKED)
    offsets, rows = segment_subset(tables.offsets, thin), np.flatnonzero(thin)
    ends = np.stack([tables.matched_keypoints(rows, every, offsets, side) for side in (0, 1)])
    K = np.linalg.inv(np.array([calibration_matrix(c) for c in tables.cameras]).reshape(-1, 3, 3))
    camera1, camera2 = tables.camera_idx[tables.pairs].T
    of_pose = so3.hat(np.nan_to_num(tables.translations)) @ tables.rotations
    of_E, of_pose = (np.swapaxes(K[camera2], 1, 2) @ E @ K[camera1] for E in (tables.E, of_pose))
    explained = np.zeros(len(every), dtype=bool)
    for points in pixels:
        epipolar = ((matrix, pixel_sampson_errors) for matrix in (tables.F, of_E, of_pose))
        for matrix, distance in (*epipolar, (tables.H, transfers)):
            report_progress("verification")
            left = np.flatnonzero(~explained)
            matches, parts = rows_of_segments(offsets, left)
            first, second = ends[:, matches]
            far = np.abs(distance(matrix[left], parts, points[first], points[second]))
            explained[left] = segment_quantiles(parts, np.nan_to_num(far, nan=FAR, posinf=FAR)) <= MAX_ERROR_PX
    return explained


def transfers(H: Array, offsets: IntArray, points1: Array, points2: Array) -> Array:
    """Transfer errors (k,) of matches under homographies, in the second image, pixels."""
    x1 = np.concatenate([points1, np.ones((len(points1), 1))], axis=1)
    moved = products_of_segments(H, offsets, x1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.linalg.norm(moved[:, :2] / moved[:, 2:] - points2, axis=1))


def _verified(tables: DatabaseTables, pairs: IntArray, seed: int) -> DatabaseTables:
    """Verify pairs with pycolmap, and replace their matches, matrices and configurations by the result."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    kept = [tables.matches[a:b] for a, b in zip(tables.offsets[:-1], tables.offsets[1:], strict=True)]
    configs = tables.configs.copy()
    matrices = {name: getattr(tables, name).copy() for name in ("E", "F", "H")}
    pixels, valid = undistorted_keypoints(tables)
    starts = np.concatenate([[0], np.cumsum([len(k) for k in tables.keypoints])])
    pinholes = [_pinhole(lens) for lens in tables.cameras]
    for count, pair in enumerate(pairs.tolist()):
        report_progress(f"{count} of {len(pairs)} pairs verified")
        images = tables.pairs[pair].tolist()
        points = [pixels[starts[image] : starts[image + 1]] for image in images]
        seen = [valid[starts[image] : starts[image + 1]] for image in images]
        matches = kept[pair][seen[0][kept[pair][:, 0]] & seen[1][kept[pair][:, 1]]]
        first, second = (pinholes[tables.camera_idx[image]] for image in images)
        geometry = pycolmap.estimate_two_view_geometry(
            first, np.nan_to_num(points[0]), second, np.nan_to_num(points[1]), matches.astype(np.uint32), options
        )
        kept[pair] = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        configs[pair] = int(geometry.config) if len(kept[pair]) >= MIN_NUM_MATCHES else DEGENERATE
        for name, matrix in matrices.items():
            value = getattr(geometry, name)
            matrix[pair] = np.nan if value is None else value
    offsets = np.concatenate([[0], np.cumsum([len(m) for m in kept])]).astype(np.int64)
    return replace(tables, matches=np.concatenate(kept), offsets=offsets, configs=configs, **matrices)


def _pinhole(lens: "pycolmap.Camera") -> "pycolmap.Camera":
    """Pinhole camera of the undistorted keypoints."""
    K = calibration_matrix(lens)
    return pycolmap.Camera(
        model="PINHOLE",
        width=lens.width,
        height=lens.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        has_prior_focal_length=lens.has_prior_focal_length,
    )
