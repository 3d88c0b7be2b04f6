"""Pairs are matched by their largest features, and by the others where the geometry of these predicts them."""

from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest

from colmap_vg.features import pair_matching
from colmap_vg.features.pair_matching import ImageFeatures, PairMatches, match_pair

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


def pair(seed: int, *, lens: pycolmap.Camera, flat: bool = False, alike: int = 0) -> Pair:
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
        pixels = np.asarray(lens.img_from_cam(local)) + rng.normal(0.0, 0.3, (count, 2))
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
