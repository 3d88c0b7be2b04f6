"""Estimate the relative poses of a database's pairs according to their two-view configurations, and refine them.

Stored poses are candidates among others, used where the inliers fit them best. Real databases were seen to hold
identity rotations and zero translations beside a valid E, and planar pairs whose stored pose is 85 degrees off.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import calibration_matrix
from colmap_vg.colmap_io.tables import (
    DEGENERATE,
    PANORAMIC,
    PLANAR,
    PLANAR_OR_PANORAMIC,
    UNCALIBRATED,
    WATERMARK,
    DatabaseTables,
)
from colmap_vg.events import report_progress
from colmap_vg.geometry.directions import normalized
from colmap_vg.options import ReadOptions
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.two_view.edge_information import MAX_NUM_STEPS, refine_relative_poses
from colmap_vg.two_view.eight_point import estimate_essential_from_inliers
from colmap_vg.two_view.essential import (
    RelativePoses,
    check_cheirality,
    essential_from_fundamental,
    essential_from_pose,
    poses_from_essential,
)
from colmap_vg.two_view.homography import calibrated_homography, poses_from_homography, pure_rotations
from colmap_vg.two_view.sampson import Matches, residuals
from colmap_vg.two_view.segments import (
    evenly_thinned,
    rows_of_segments,
    segment_of_rows,
    segment_quantiles,
    segment_subset,
    segment_sums,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_SHARE_IN_FRONT = 0.5
"""Minimum share of matches in front of both cameras; poses with a smaller one are not used."""
MAX_MEDIAN_ERROR_PX = 4.0
"""Maximum median Sampson error of a pose's matches, pixels: COLMAP's threshold of two-view verification."""
MIN_ANGLE = np.radians(0.2)
"""Median triangulation angle, radians, below which a pair does not determine its direction."""
MAX_SPURIOUS_ANGLE = np.radians(3.0)
"""Maximum median triangulation angle, radians, that noise alone gives to a pair without baseline."""
ROTATION_SHARE = 1.3
"""A pair is a pure rotation if the median error of a rotation is at most this factor above the one expected from the
full pose's median error. The full pose fits some of the noise (measured: a factor of 1.05 to 1.25)."""
ROTATION_NOISE = 2.47
"""Ratio of the median error of a rotation to that of an epipolar line for the same noise: sqrt(2) 1.177 (both
coordinates of both matched points, median of the Rayleigh distribution) over 0.6745 (one normal variable)."""
MIN_FITTING_SHARE, MIN_NUM_FITTING = 0.8, 100
"""Minimum share and number of matches that fit a calibrated pose, for a pair that COLMAP labelled uncalibrated under a
trusted focal length to be used: false pairs of repeated structure reached 74 matches, and shares up to 0.96."""
MAX_MATCHES_PER_CHOICE = 150
"""Maximum number of a pair's matches that compare candidate poses, whose errors differ greatly."""
SAME_MATRIX = 1e-8
"""One minus the cosine between two essential matrices below which they are equal: 0.01 degrees, far less than the
refinement changes a pose."""


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """Relative poses of pairs with their precision and verdicts.

    Attributes
    ----------
    rotations : (m, 3, 3) array
        cam2_from_cam1.
    directions : (m, 3) array
        Unit vectors from the first camera to the second, in the first camera's frame.
    angles : (m,) array
        Median triangulation angles, radians.
    information : (m, 5, 5) array
        See `RefinedEdges`.
    planar : (m,) bool array
    verdicts : (m,) str array
    """

    rotations: Array
    directions: Array
    angles: Array
    information: Array
    planar: BoolArray
    verdicts: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class _Matches:
    """Bearings of all pairs' inlier matches."""

    offsets: IntArray
    bearings1: Array
    bearings2: Array

    @cached_property
    def _rays(self) -> Matches:
        variances = np.ones(len(self.offsets) - 1)
        return Matches.of_rays(self.offsets, self.bearings1, self.bearings2, variances, variances)

    def errors(self, poses: RelativePoses) -> Array:
        """Absolute Sampson error of each match, radians."""
        return np.abs(residuals(self._rays, poses.rotations, poses.directions))

    def medians(self, errors: Array) -> Array:
        """Median error of each pair's matches, (m,); infinite for pairs without matches."""
        return np.nan_to_num(segment_quantiles(self.offsets, errors), nan=np.inf)

    def shares_within(self, errors: Array, bounds: Array) -> Array:
        """Share of each pair's matches with an error of at most its bound (m,); 0 without matches."""
        within = errors <= bounds[segment_of_rows(self.offsets)]
        return segment_sums(self.offsets, within.astype(np.float64)) / np.maximum(np.diff(self.offsets), 1)

    def judged(self, rotations: Array, directions: Array) -> RelativePoses:
        report_progress("relative poses")
        return check_cheirality(rotations, directions, self.offsets, self.bearings1, self.bearings2)

    def of(self, pairs: IntArray) -> "_Matches":
        rows, offsets = rows_of_segments(self.offsets, pairs)
        return _Matches(offsets, self.bearings1[rows], self.bearings2[rows])

    def thinned(self, limit: int) -> "_Matches":
        report_progress("relative poses")
        thin = evenly_thinned(self.offsets, limit)
        return _Matches(segment_subset(self.offsets, thin), self.bearings1[thin], self.bearings2[thin])


def relative_poses(
    tables: DatabaseTables,
    focal_scales: Array,
    focal_trusted: BoolArray,
    offsets: IntArray,
    bearings1: Array,
    bearings2: Array,
    options: ReadOptions,
    max_num_steps: int = MAX_NUM_STEPS,
) -> PairGeometry:
    """Estimate the relative poses of all pairs, and give each a verdict.

    Parameters
    ----------
    tables : DatabaseTables
    focal_scales : (c,) array
        Factors on the database's focal lengths with which the bearings were computed.
    focal_trusted : (c,) bool array
        Whether each focal length is trusted. UNCALIBRATED pairs of two cameras that are need more matches.
    offsets : (m + 1,) int array
        Matches of pair k are rows ``offsets[k]:offsets[k + 1]`` of the bearings.
    bearings1, bearings2 : (k, 3) array
        Unit vectors in the first and the second camera's frame.
    options : ReadOptions
        `min_num_inliers` and `max_matches_per_pose`.
    max_num_steps : int
        Maximum number of steps that refine each pose.

    Returns
    -------
    PairGeometry
    """
    every = _Matches(offsets, bearings1, bearings2)
    matches = every.thinned(options.max_matches_per_pose)
    cameras = tables.camera_idx[tables.pairs]
    K = np.array([calibration_matrix(c, s) for c, s in zip(tables.cameras, focal_scales, strict=True)])
    K = K.reshape(-1, 3, 3)
    planar = np.isin(tables.configs, (PLANAR, PLANAR_OR_PANORAMIC)) & ~tables.spherical
    unchanged = (focal_scales[cameras] == 1.0).all(axis=1)
    poses = _initial_poses(tables, every.thinned(MAX_MATCHES_PER_CHOICE), K[cameras], planar, unchanged)
    focal = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    num_matches = np.diff(every.offsets)
    enough = num_matches >= max(options.min_num_inliers, 5)
    refined = refine_relative_poses(
        matches.offsets,
        matches.bearings1,
        matches.bearings2,
        poses.rotations,
        poses.directions,
        focal[cameras[:, 0]],
        focal[cameras[:, 1]],
        max_num_steps=max_num_steps,
    )
    rotations = np.where(enough[:, None, None], refined.rotations, poses.rotations)
    directions = np.where(enough[:, None], refined.directions, poses.directions)
    final = matches.judged(rotations, normalized(directions))
    errors, pair_focal = matches.errors(final), np.sqrt(focal[cameras[:, 0]] * focal[cameras[:, 1]])
    medians = matches.medians(errors)
    still, turns = _pure_rotation(matches, final, medians)
    final = replace(final, rotations=np.where(still[:, None, None], turns, final.rotations))
    fitting = matches.shares_within(errors, MAX_MEDIAN_ERROR_PX / pair_focal)
    unfit = (fitting < MIN_FITTING_SHARE) | (fitting * num_matches < MIN_NUM_FITTING)
    verdicts = _verdicts(
        tables.configs,
        final.share_in_front,
        medians * pair_focal,
        still=still,
        refuted=focal_trusted[cameras].all(axis=1) & unfit,
        few=num_matches < options.min_num_inliers,
    )
    return PairGeometry(final.rotations, final.directions, final.median_angles, refined.information, planar, verdicts)


def _verdicts(
    configs: IntArray, share_in_front: Array, error_px: Array, *, still: BoolArray, refuted: BoolArray, few: BoolArray
) -> NDArray[np.str_]:
    """Verdict of each pair (m,); the last reason that applies wins.

    Parameters
    ----------
    configs : (m,) int array
        COLMAP's configurations.
    share_in_front : (m,) array
        Share of the matches in front of both cameras.
    error_px : (m,) array
        Median error of the matches, pixels.
    still : (m,) bool array
        Pairs that a pure rotation explains.
    refuted : (m,) bool array
        Pairs of trusted focal lengths whose matches do not fit them.
    few : (m,) bool array
        Pairs with too few matches.
    """
    verdicts = np.full(len(configs), EdgeVerdict.KEPT, dtype=object)
    verdicts[still | (configs == PANORAMIC)] = EdgeVerdict.ROTATION_ONLY
    unexplained = (share_in_front < MIN_SHARE_IN_FRONT) & (verdicts == EdgeVerdict.KEPT)
    verdicts[unexplained | ((error_px > MAX_MEDIAN_ERROR_PX) & ~still)] = EdgeVerdict.NO_POSE
    verdicts[(configs == UNCALIBRATED) & refuted] = EdgeVerdict.UNCALIBRATED
    verdicts[configs == WATERMARK] = EdgeVerdict.WATERMARK
    verdicts[configs == DEGENERATE] = EdgeVerdict.DEGENERATE
    verdicts[few] = EdgeVerdict.FEW_INLIERS
    return verdicts.astype(str)


def _initial_poses(
    tables: DatabaseTables, matches: _Matches, K: Array, planar: BoolArray, unchanged: BoolArray
) -> RelativePoses:
    """Best of each pair's stored pose and those of its matrices, with its cameras' calibrations K (m, 2, 3, 3)."""
    K1, K2 = K[:, 0], K[:, 1]
    E = _essential_matrices(tables, matches, K1, K2, unchanged)
    poses = _better_of_stored_and_decomposed(tables, matches, E, unchanged)
    return _better_planar(tables, matches, K1, K2, planar, poses)


def _essential_matrices(tables: DatabaseTables, matches: _Matches, K1: Array, K2: Array, unchanged: BoolArray) -> Array:
    """Essential matrices: E if it was estimated with the same focal lengths, else from F, else from the matches."""
    E = np.where(unchanged[:, None, None], tables.E, np.nan)
    from_F = essential_from_fundamental(tables.F, K1, K2)
    from_F[tables.spherical] = np.nan
    missing = ~_usable(E)
    E = np.where(missing[:, None, None], from_F, E)
    missing = ~_usable(E)
    if missing.any():
        refitted = estimate_essential_from_inliers(matches.offsets, matches.bearings1, matches.bearings2)
        E = np.where(missing[:, None, None], refitted, E)
    return np.where(_usable(E)[:, None, None], E, np.diag([1.0, 1.0, 0.0]))


def _better_of_stored_and_decomposed(
    tables: DatabaseTables, matches: _Matches, E: Array, unchanged: BoolArray
) -> RelativePoses:
    """Stored poses that are decompositions of E; elsewhere the stored pose or that of E, whichever fits better."""
    length = np.linalg.norm(tables.translations, axis=1)
    with np.errstate(invalid="ignore"):
        present = unchanged & np.isfinite(tables.rotations).all(axis=(1, 2)) & (length > 0)
    R = np.where(present[:, None, None], tables.rotations, np.eye(3))
    t = np.where(present[:, None], tables.translations, np.array([0.0, 0.0, 1.0]))
    d = normalized(-np.einsum("kba,kb->ka", R, t))
    stored = matches.judged(R, d)
    of_stored = essential_from_pose(R, d)
    cosine = np.einsum("kab,kab->k", of_stored, E) / (
        np.linalg.norm(E, axis=(1, 2)) * np.linalg.norm(of_stored, axis=(1, 2))
    )
    same = present & (np.abs(cosine) > 1.0 - SAME_MATRIX) & (stored.share_in_front > MIN_SHARE_IN_FRONT)
    rest = np.flatnonzero(~same)
    if not len(rest):
        return stored
    of_rest = matches.of(rest)
    decomposed = poses_from_essential(E[rest], of_rest.offsets, of_rest.bearings1, of_rest.bearings2)
    own = stored.of(rest)
    better = present[rest] & _preferred(of_rest, own, decomposed)
    return stored.replaced(rest, _where(better, own, decomposed))


def _better_planar(
    tables: DatabaseTables, matches: _Matches, K1: Array, K2: Array, planar: BoolArray, poses: RelativePoses
) -> RelativePoses:
    """Replace poses of planar pairs by the homography's better decomposition where it fits the matches better."""
    with_H = planar & _usable(tables.H)
    if not with_H.any():
        return poses
    H = np.where(with_H[:, None, None], tables.H, np.eye(3))
    found = poses_from_homography(
        calibrated_homography(H, K1, K2), matches.offsets, matches.bearings1, matches.bearings2
    )
    return _where(with_H & _preferred(matches, found.better, poses), found.better, poses)


def _preferred(matches: _Matches, one: RelativePoses, other: RelativePoses) -> BoolArray:
    """Whether one pose fits better: clearly more matches in front of both cameras, or as many and a lower error."""
    margin = 0.1
    ahead = one.share_in_front - other.share_in_front
    closer = matches.medians(matches.errors(one)) < matches.medians(matches.errors(other))
    return np.asarray((ahead > margin) | ((ahead > -margin) & closer))


def _where(mask: BoolArray, one: RelativePoses, other: RelativePoses) -> RelativePoses:
    rows = np.flatnonzero(mask)
    return other.replaced(rows, one.of(rows))


def _pure_rotation(matches: _Matches, poses: RelativePoses, medians: Array) -> tuple[BoolArray, Array]:
    """Whether a pure rotation fits each pair about as well as its pose, (m,), and the rotations to use, (m, 3, 3)."""
    turned, rotations = poses.median_angles < MIN_ANGLE, poses.rotations.copy()
    suspects = np.flatnonzero(poses.median_angles < MAX_SPURIOUS_ANGLE)
    of_suspects = matches.of(suspects)
    found = pure_rotations(of_suspects.offsets, of_suspects.bearings1, of_suspects.bearings2)
    expected = ROTATION_NOISE * np.maximum(medians[suspects], 1e-4)
    turned[suspects] |= found.median_errors <= ROTATION_SHARE * expected
    rotations[suspects] = found.rotations
    return turned, rotations


def _usable(matrices: Array) -> BoolArray:
    """Whether each matrix is finite and not zero."""
    return np.asarray(
        np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(np.nan_to_num(matrices)).max(axis=(1, 2), initial=0.0) > 0)
    )
