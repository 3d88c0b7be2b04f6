"""Pairs are matched by their largest features, and by the others where the geometry of these predicts them."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest

from colmap_vg.features import pair_matching
from colmap_vg.features.nearest_descriptors import Nearest, epipolar_matches, homography_matches
from colmap_vg.features.pair_matching import (
    MAX_EPIPOLAR_ERROR_PX,
    MAX_SHIFT,
    MIN_EPIPOLAR_ERROR_PX,
    MIN_TRIALS,
    ImageFeatures,
    PairMatches,
    match_pair,
)

NUM_LARGE, NUM_SMALL, NUM_CLUTTER = 250, 1500, 400


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    shares = rng.gamma(0.3, size=(count, 128))
    return np.rint(512 * np.sqrt(shares / shares.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)


def camera(k: float = 0.0, prior: bool = True) -> pycolmap.Camera:
    found = pycolmap.Camera(model="SIMPLE_RADIAL", width=1200, height=900, params=[800.0, 600.0, 450.0, k])
    found.has_prior_focal_length = prior
    return found


@dataclass
class Pair:
    """Two images of the same points: feature i of both is point i, large ones first, clutter last."""

    first: ImageFeatures
    second: ImageFeatures

    def matched(self, options: pycolmap.TwoViewGeometryOptions | None = None) -> PairMatches:
        if options is None:
            options = pycolmap.TwoViewGeometryOptions()
            options.ransac.random_seed = 0
        return match_pair(self.first, self.second, options)


def pair(seed: int, *, lens: pycolmap.Camera, flat: bool = False, alike: int = 0, noise_px: float = 0.3) -> Pair:
    """Some of the large features have a look-alike in image 2, far from their epipolar line."""
    rng = np.random.default_rng(seed)
    count = NUM_LARGE + NUM_SMALL
    points = rng.uniform([-3.0, -2.2, 4.0], [3.0, 2.2, 8.0], (count, 3))
    if flat:
        points[:, 2] = 5.0 + 0.2 * points[:, 0]
    scales = np.concatenate([np.full(NUM_LARGE, 8.0), np.full(NUM_SMALL + NUM_CLUTTER, 2.0)])
    shared = descriptors(rng, count)
    images = []
    for offset, turn in ((0.0, 0.0), (0.8, -0.06)):
        R = pycolmap.Rotation3d(np.array([0.0, np.sin(turn / 2), 0.0, np.cos(turn / 2)])).matrix()
        local = (points - [offset, 0.0, 0.0]) @ R.T
        pixels = np.asarray(lens.img_from_cam(local)) + rng.normal(0.0, noise_px, (count, 2))
        pixels = np.concatenate([pixels, rng.uniform(0.0, [1200.0, 900.0], (NUM_CLUTTER, 2))])
        noisy = (shared.astype(int) + rng.integers(-12, 13, shared.shape)).clip(0, 255).astype(np.uint8)
        own = np.concatenate([noisy, descriptors(rng, NUM_CLUTTER)])
        keypoints = np.zeros((len(pixels), 6), np.float32)
        keypoints[:, :2], keypoints[:, 2], keypoints[:, 5] = pixels, scales, scales
        images.append(ImageFeatures(lens, keypoints, own, np.arange(NUM_LARGE)))
    second = images[1]
    for k in range(alike):
        second.descriptors[100 + k] = second.descriptors[k]
        second.keypoints[100 + k, :2] = second.keypoints[k, :2] + [0.0, 150.0]
    return Pair(*images)


def share_right(found: np.ndarray, rows: range) -> tuple[float, float]:
    """Share of the rows that are matched rightly, and share of the matches that are right."""
    right = found[:, 0] == found[:, 1]
    return np.isin(rows, found[right, 0]).mean(), right.mean()


@pytest.mark.parametrize("lens", [camera(), camera(prior=False), camera(-0.2)], ids=["known", "unknown", "bent"])
def test_small_features_are_found_along_the_lines_of_the_large(lens: pycolmap.Camera) -> None:
    scene = pair(0, lens=lens)
    found = scene.matched()
    recall, precision = share_right(np.asarray(found.geometry.inlier_matches), range(NUM_LARGE, NUM_LARGE + NUM_SMALL))
    assert recall > 0.9
    assert precision > 0.99
    assert len(np.unique(found.matches[:, 0])) == len(np.unique(found.matches[:, 1])) == len(found.matches)


def test_small_features_of_a_plane_are_found_near_their_places() -> None:
    found = pair(1, lens=camera(), flat=True).matched()
    kinds = pycolmap.TwoViewGeometryConfiguration
    assert found.geometry.config in (kinds.PLANAR, kinds.PLANAR_OR_PANORAMIC)
    recall, precision = share_right(np.asarray(found.geometry.inlier_matches), range(NUM_LARGE, NUM_LARGE + NUM_SMALL))
    assert recall > 0.9
    assert precision > 0.99


def test_features_that_brute_force_turned_down_are_not_matched_along_lines() -> None:
    found = pair(2, lens=camera(), alike=40).matched()
    assert not np.isin(found.matches[:, 0], np.arange(40)).any()
    recall, _ = share_right(found.matches, range(NUM_LARGE, NUM_LARGE + NUM_SMALL))
    assert recall > 0.9


def test_images_of_different_things_have_no_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = pair(3, lens=camera()), pair(4, lens=camera())
    monkeypatch.delattr(pair_matching, "_verified")  # which takes long where nothing agrees
    found = Pair(one.first, other.second).matched()
    assert len(found.matches) < 30
    assert len(found.geometry.inlier_matches) == 0


def test_a_feature_has_one_match_only() -> None:
    matches, inliers = np.array([[0, 5], [1, 6], [2, 7], [3, 8]]), np.array([[0, 5], [1, 6]])
    near_lines = np.array([[0, 9], [2, 10], [4, 8], [5, 6], [6, 11]])
    joined = pair_matching._joined(matches, inliers, near_lines)
    assert joined.tolist() == [[0, 5], [1, 6], [2, 10], [4, 8], [6, 11]]


def test_verification_obeys_its_options() -> None:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = 10 * (NUM_LARGE + NUM_SMALL)
    assert len(pair(0, lens=camera()).matched(options).geometry.inlier_matches) == 0


def with_first(scene: Pair, count: int) -> Pair:
    return Pair(replace(scene.first, largest=np.arange(count)), replace(scene.second, largest=np.arange(count)))


def test_few_features_are_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    compared, mutual_matches = [], pair_matching.more_mutual_matches

    def counted(one: np.ndarray, other: np.ndarray, known: Nearest | None) -> tuple[np.ndarray, Nearest]:
        compared.append((len(one), len(other)))
        assert (known is None) == (len(compared) == 1)
        return mutual_matches(one, other, known)

    monkeypatch.setattr(pair_matching, "more_mutual_matches", counted)
    monkeypatch.setattr(pair_matching, "NUM_TRIED_FEATURES", 200)
    scene = pair(0, lens=camera())
    found = with_first(scene, 1000).matched()
    assert compared == [(200, 200)]
    recall, precision = share_right(np.asarray(found.geometry.inlier_matches), range(NUM_LARGE + NUM_SMALL))
    assert recall > 0.9
    assert precision > 0.99
    # Too few inliers, or too few features to leave some: those that are matched first, at once.
    compared.clear()
    monkeypatch.setattr(pair_matching, "MIN_TRIED_INLIERS", 201)
    all_first = with_first(scene, 1000).matched()
    assert compared == [(200, 200), (1000, 1000)]
    assert len(all_first.geometry.inlier_matches) > 0.9 * len(found.geometry.inlier_matches)
    compared.clear()
    with_first(scene, 200).matched()
    assert compared == [(200, 200)]
    compared.clear()
    count = NUM_LARGE + NUM_SMALL + NUM_CLUTTER
    with_first(scene, count).matched()
    assert compared == [(count, count)]
    # Of images that show different things no more features are compared.
    compared.clear()
    unlike = with_first(Pair(scene.first, pair(4, lens=camera()).second), 1000)
    assert len(unlike.matched().geometry.inlier_matches) == 0
    assert compared == [(200, 200)]


def test_few_features_are_verified_by_the_options_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_matching, "NUM_TRIED_FEATURES", 200)
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = 10 * (NUM_LARGE + NUM_SMALL)
    assert len(with_first(pair(0, lens=camera()), 1000).matched(options).geometry.inlier_matches) == 0
    assert options.min_num_inliers == 10 * (NUM_LARGE + NUM_SMALL)


def test_features_that_are_large_in_one_image_only_are_matched() -> None:
    scene = pair(5, lens=camera())
    scene.second = replace(scene.second, largest=np.arange(80, NUM_LARGE + 80))
    recall, precision = share_right(scene.matched().matches, range(80))
    assert recall > 0.9
    assert precision > 0.97


@pytest.mark.parametrize("lens", [camera(), camera(prior=False)], ids=["known", "unknown"])
@pytest.mark.parametrize(
    ("noise_px", "low", "high"),
    [
        (0.02, MIN_EPIPOLAR_ERROR_PX, MIN_EPIPOLAR_ERROR_PX),
        (0.5, 1.5, 3.0),
        (1.4, MAX_EPIPOLAR_ERROR_PX, MAX_EPIPOLAR_ERROR_PX),
    ],
)
def test_the_distance_from_a_line_follows_the_errors_of_the_large_features(
    noise_px: float, low: float, high: float, lens: pycolmap.Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def near_lines(*arguments: object) -> np.ndarray:
        asked.append(arguments[-1])
        return epipolar_matches(*arguments)

    monkeypatch.setattr(pair_matching, "epipolar_matches", near_lines)
    pair(0, lens=lens, noise_px=noise_px).matched()
    unit = lens.mean_focal_length() if lens.has_prior_focal_length else 1.0
    assert low * (1.0 - 1e-9) <= asked[0] * unit <= high * (1.0 + 1e-9)


def test_the_distance_from_a_predicted_place_is_a_share_of_the_longer_side(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def near_places(*arguments: object) -> np.ndarray:
        asked.append(arguments[-1])
        return homography_matches(*arguments)

    monkeypatch.setattr(pair_matching, "homography_matches", near_places)
    pair(1, lens=camera(), flat=True).matched()
    assert asked == [MAX_SHIFT * 1200]


def test_a_geometry_with_fewer_inliers_than_that_of_the_large_features_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    verify, found = pair_matching._verified, []

    def verified(*arguments: object) -> pycolmap.TwoViewGeometry:
        found.append(verify(*arguments) if not found else pycolmap.TwoViewGeometry())
        return found[-1]

    monkeypatch.setattr(pair_matching, "_verified", verified)
    result = pair(0, lens=camera()).matched()
    assert len(found) == 2
    assert result.geometry is found[0]
    assert set(map(tuple, result.geometry.inlier_matches.tolist())) <= set(map(tuple, result.matches.tolist()))


def test_verification_tries_little_and_leaves_its_options_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    estimate, seen = pycolmap.estimate_two_view_geometry, []

    def estimated(*arguments: object) -> pycolmap.TwoViewGeometry:
        *_, matches, own = arguments
        seen.append((len(matches), own.ransac.min_num_trials, own.ransac.min_inlier_ratio))
        return estimate(*arguments)

    monkeypatch.setattr(pycolmap, "estimate_two_view_geometry", estimated)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.min_inlier_ratio = 0.05
    before = options.todict()
    pair(0, lens=camera()).matched(options)
    assert options.todict() == before
    assert len(seen) == 2
    for count, trials, ratio in seen:
        assert trials == MIN_TRIALS < before["ransac"]["min_num_trials"]
        assert ratio == max(0.05, options.min_num_inliers / count)
    assert seen[0][2] > 0.05


def test_a_fisheye_without_a_focal_length_is_verified() -> None:
    lens = pycolmap.Camera(model="SIMPLE_FISHEYE", width=1200, height=900, params=[1440.0, 600.0, 450.0])
    found = pair(0, lens=lens).matched()
    inliers = np.asarray(found.geometry.inlier_matches)
    assert found.geometry.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    assert len(inliers) > 0.5 * NUM_LARGE
