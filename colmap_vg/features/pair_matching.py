"""Match two images: their largest features first, then the others where the geometry of these predicts them.

Features of the largest scales are few and the most repeatable. They are matched by brute force, and where they verify
an epipolar geometry, all features are matched near its lines: of 8,192 features a twentieth of the products. In pairs
on one plane, whose epipolar lines are undetermined, they are matched near where the homography takes them.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import is_bent_by_focal
from colmap_vg.features.nearest_descriptors import (
    Nearest,
    epipolar_matches,
    homography_matches,
    more_mutual_matches,
    mutual_matches,
)
from colmap_vg.features.orientation_votes import excess_over_chance, log2_scales, num_agreeing, orientations
from colmap_vg.two_view.sampson_errors import pixel_sampson_errors

MAX_FIRST_FEATURES = 2048
"""Features of each image that are matched first, those of largest scale."""
NUM_TRIED_FEATURES, MIN_TRIED_INLIERS = 1024, 40
"""Of these, features that are tried alone where both images have more than `MAX_FIRST_FEATURES`, and the inliers that
suffice to predict the others: of rendered views 80 of 88 pairs were done in two thirds of the time, with as many
inliers."""
MIN_TRIED_EXCESS = 2.0
"""Of the matches of these features, number that agree beyond chance below which no more features are matched: of six
sets of photographs 3 of 241 such pairs would have been verified, and 229 of the 311 others that were not done."""
MIN_CONSISTENT = 10
"""Matches that agree on a rotation and a change of scale, below which pairs are not verified: a geometry needs 15
inliers, of which perspective leaves a third outside the fullest two by two bins at most."""
MIN_TRIALS = 20
"""RANSAC trials at least, in place of 100: where few are outliers, 20 find the same inliers."""
MIN_EPIPOLAR_ERROR_PX = 1.0
"""Minimum distance from the epipolar line, pixels, within which features are matched: geometries are no more exact."""
MAX_EPIPOLAR_ERROR_PX = 4.0
"""Maximum of that distance, pixels: RANSAC's threshold for inliers."""
MAX_SHIFT = 0.06
"""Distance from the place that a homography predicts within which features are matched, share of the longer side."""
_RESIDUALS_IN_BOUND = 6.3
"""Median Sampson errors of the first inliers in the bound on the distance from a line: three standard deviations of a
normal error that both images share."""

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """Features of an image, and the camera that took it.

    Attributes
    ----------
    camera : pycolmap.Camera
    keypoints : (k, 6) float32 array
        x, y in pixels, and the affine shape.
    descriptors : (k, 128) uint8 array
    largest : (h,) int64 array
        Rows of the features that are matched first, in order of decreasing scale.
    """

    camera: pycolmap.Camera
    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    largest: IntArray

    @property
    def points(self) -> Array:
        """Keypoints (k, 2), pixels."""
        return np.ascontiguousarray(self.keypoints[:, :2], dtype=np.float64)

    @property
    def has_more(self) -> bool:
        """Whether there are features beyond those that are matched first."""
        return len(self.largest) < len(self.keypoints)


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches (k, 2) of two images, and the two-view geometry with those that it verifies."""

    matches: IntArray
    geometry: pycolmap.TwoViewGeometry


def match_pair(first: ImageFeatures, second: ImageFeatures, options: pycolmap.TwoViewGeometryOptions) -> PairMatches:
    """Match and verify two images by their largest features, and by all where these agree.

    Parameters
    ----------
    first, second : ImageFeatures
    options : pycolmap.TwoViewGeometryOptions
        Of the verification.

    Returns
    -------
    PairMatches
        Matches of the largest features, and those found where their geometry predicts them.
    """
    nearest: Nearest | None = None
    if min(len(first.largest), len(second.largest)) > NUM_TRIED_FEATURES and first.has_more and second.has_more:
        few = [replace(image, largest=image.largest[:NUM_TRIED_FEATURES]) for image in (first, second)]
        many = pycolmap.TwoViewGeometryOptions(**options.todict(recursive=False))
        many.min_num_inliers = max(options.min_num_inliers, MIN_TRIED_INLIERS)
        found, excess, nearest = _match_largest(few[0], few[1], many)
        if len(found.geometry.inlier_matches):
            return _match_others(few[0], few[1], found, options)
        if excess < MIN_TRIED_EXCESS:
            return found
    found, _, _ = _match_largest(first, second, options, nearest)
    if len(found.geometry.inlier_matches) and (first.has_more or second.has_more):
        return _match_others(first, second, found, options)
    return found


def _match_largest(
    first: ImageFeatures,
    second: ImageFeatures,
    options: pycolmap.TwoViewGeometryOptions,
    known: Nearest | None = None,
) -> tuple[PairMatches, float, Nearest]:
    """Match the largest features by brute force, and verify them where they agree on a rotation and a scale.

    Also return how many more agree than by chance, and the nearest neighbours, to go on from with more features.
    """
    rows, nearest = more_mutual_matches(first.descriptors[first.largest], second.descriptors[second.largest], known)
    matches = np.stack([first.largest[rows[:, 0]], second.largest[rows[:, 1]]], axis=1)
    agreeing, excess = agreement(first, second, matches)
    if agreeing < MIN_CONSISTENT or excess == 0.0:
        return PairMatches(matches, pycolmap.TwoViewGeometry()), excess, nearest
    return PairMatches(matches, _verified(first, second, matches, options)), excess, nearest


def _match_others(
    first: ImageFeatures, second: ImageFeatures, found: PairMatches, options: pycolmap.TwoViewGeometryOptions
) -> PairMatches:
    """Match all features where the geometry of the largest ones predicts them."""
    matches, geometry = found.matches, found.geometry
    if first.camera.is_spherical() or second.camera.is_spherical():
        return match_all_features(first, second, options)
    if _determines_lines(geometry):
        more = _near_lines(first, second, geometry)
    elif geometry.H is not None:
        more = _near_places(first, second, np.asarray(geometry.H))
    else:
        return match_all_features(first, second, options)
    tried = np.isin(more[:, 0], first.largest) & np.isin(more[:, 1], second.largest)
    matches = _joined(matches, np.asarray(geometry.inlier_matches, dtype=np.int64), more[~tried])
    verified = _verified(first, second, matches, options)
    if len(verified.inlier_matches) < len(geometry.inlier_matches):
        return PairMatches(matches, geometry)
    return PairMatches(matches, verified)


def _joined(matches: IntArray, inliers: IntArray, more: IntArray) -> IntArray:
    """Matches of the largest features, and more matches of features that are in no inlier match of these."""
    new = ~np.isin(more[:, 0], inliers[:, 0]) & ~np.isin(more[:, 1], inliers[:, 1])
    old = ~np.isin(matches[:, 0], more[new, 0]) & ~np.isin(matches[:, 1], more[new, 1])
    joined = np.concatenate([matches[old], more[new]])
    return np.asarray(joined[np.argsort(joined[:, 0], kind="stable")])


def match_all_features(
    first: ImageFeatures, second: ImageFeatures, options: pycolmap.TwoViewGeometryOptions
) -> PairMatches:
    """Match all features of two images by brute force, and verify them; parameters as for :func:`match_pair`."""
    matches = mutual_matches(first.descriptors, second.descriptors)
    return PairMatches(matches, _verified(first, second, matches, options))


def agreement(first: ImageFeatures, second: ImageFeatures, matches: IntArray) -> tuple[int, float]:
    """Number of matches that agree on a rotation and a change of scale, and how many more these are than by chance."""
    a, b = first.keypoints[matches[:, 0]], second.keypoints[matches[:, 1]]
    agreeing = num_agreeing(orientations(a) - orientations(b), log2_scales(a) - log2_scales(b))
    return agreeing, float(excess_over_chance(np.array(agreeing), np.array(len(matches))))


def _verified(
    first: ImageFeatures,
    second: ImageFeatures,
    matches: IntArray,
    options: pycolmap.TwoViewGeometryOptions,
) -> pycolmap.TwoViewGeometry:
    """Verify matches; RANSAC does not search for a share of inliers that would be less than their minimum number."""
    if len(matches) < options.min_num_inliers:
        return pycolmap.TwoViewGeometry()
    options = pycolmap.TwoViewGeometryOptions(**options.todict(recursive=False))
    options.ransac.min_inlier_ratio = max(options.ransac.min_inlier_ratio, options.min_num_inliers / len(matches))
    options.ransac.min_num_trials = MIN_TRIALS
    lenses = [_verifiable(image.camera) for image in (first, second)]
    return pycolmap.estimate_two_view_geometry(
        lenses[0], first.points, lenses[1], second.points, matches.astype(np.uint32), options
    )


def _verifiable(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A pinhole camera in place of a fisheye without a focal length, of which COLMAP verifies no pair.

    Nine in ten true matches agree with a fundamental matrix of the distorted pixels.
    """
    if camera.has_prior_focal_length or not is_bent_by_focal(camera):
        return camera
    return pycolmap.Camera.create_from_model_id(
        1, pycolmap.CameraModelId.SIMPLE_PINHOLE, 1.0, camera.width, camera.height
    )


def _determines_lines(geometry: pycolmap.TwoViewGeometry) -> bool:
    kinds = pycolmap.TwoViewGeometryConfiguration
    if geometry.config == kinds.CALIBRATED:
        return geometry.E is not None
    return geometry.config == kinds.UNCALIBRATED and geometry.F is not None


def _near_lines(first: ImageFeatures, second: ImageFeatures, geometry: pycolmap.TwoViewGeometry) -> IntArray:
    """Matches near the lines of an essential matrix, whose cameras have distortion, or of a fundamental matrix."""
    points, matrix, pixel = [first.points, second.points], np.asarray(geometry.F), 1.0
    inliers = np.asarray(geometry.inlier_matches, dtype=np.int64)
    if geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED:
        points = [
            np.asarray(image.camera.cam_from_img(at), dtype=np.float64).reshape(-1, 2)
            for image, at in zip((first, second), points, strict=True)
        ]
        matrix, pixel = np.asarray(geometry.E), 1.0 / second.camera.mean_focal_length()
    seen = [np.flatnonzero(np.isfinite(at).all(axis=1)) for at in points]
    offsets = np.array([0, len(inliers)])
    errors = pixel_sampson_errors(matrix[None], offsets, points[0][inliers[:, 0]], points[1][inliers[:, 1]])
    bound = _RESIDUALS_IN_BOUND * float(np.nanmedian(np.abs(errors)))
    bound = float(np.clip(bound, MIN_EPIPOLAR_ERROR_PX * pixel, MAX_EPIPOLAR_ERROR_PX * pixel))
    matches = epipolar_matches(
        matrix,
        points[0][seen[0]],
        points[1][seen[1]],
        first.descriptors[seen[0]],
        second.descriptors[seen[1]],
        bound,
    )
    return np.stack([seen[0][matches[:, 0]], seen[1][matches[:, 1]]], axis=1)


def _near_places(first: ImageFeatures, second: ImageFeatures, H: Array) -> IntArray:
    """Matches near where a homography takes the features."""
    max_shift = MAX_SHIFT * max(second.camera.width, second.camera.height)
    return homography_matches(H, first.points, second.points, first.descriptors, second.descriptors, max_shift)
