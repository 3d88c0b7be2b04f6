"""Features of OpenCV in the form of COLMAP's, beside COLMAP's own."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rendered_corner import render_corner
from scipy.spatial import cKDTree

from colmap_vg.features import sift
from colmap_vg.features.nearest_descriptors import mutual_matches
from colmap_vg.features.orientation_votes import log2_scales, orientations
from colmap_vg.features.sift import Features, sift_features


@pytest.fixture(scope="module")
def grey() -> np.ndarray:
    return cv2.cvtColor(render_corner(1).images[0], cv2.COLOR_BGR2GRAY)


def nearest(found: Features, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of features and of others that lie within a pixel of each other, alike in scale and orientation."""
    mine, theirs = (
        np.column_stack([of[:, :2], 5 * np.cos(orientations(of)), 5 * np.sin(orientations(of)), 3 * log2_scales(of)])
        for of in (found.keypoints, others)
    )
    distances, rows = cKDTree(theirs).query(mine)
    alike = distances < 1.2  # within 1.2 pixels, 14 degrees and 0.4 octaves
    return np.flatnonzero(alike), rows[alike]


def test_features_are_in_colmaps_convention(tmp_path: Path, grey: np.ndarray) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    pycolmap.extract_features(
        tmp_path / "a.db", tmp_path, ["a.png"], extraction_options=options, device=pycolmap.Device.cpu
    )
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        (image,) = database.read_all_images()
        keypoints = database.read_keypoints(image.image_id)
        descriptors = database.read_descriptors(image.image_id).data
    found = sift_features(grey, 8192, 3200)
    mine, theirs = nearest(found, keypoints)
    assert len(mine) > 0.5 * min(len(found.keypoints), len(keypoints))
    difference = found.keypoints[mine] - keypoints[theirs]
    np.testing.assert_allclose(np.median(difference[:, :2], axis=0), 0.0, atol=0.02)
    cosines = np.sum(found.descriptors[mine].astype(float) * descriptors[theirs], axis=1) / 512.0**2
    assert np.median(cosines) > 0.99
    matches = mutual_matches(found.descriptors, descriptors)
    off = found.keypoints[matches[:, 0], :2] - keypoints[matches[:, 1], :2]
    assert np.mean(np.hypot(*off.T) < 1.0) > 0.9


def test_descriptors_have_the_norm_of_colmaps(grey: np.ndarray) -> None:
    norms = np.linalg.norm(sift_features(grey, 500, 3200).descriptors.astype(float), axis=1)
    np.testing.assert_allclose(norms, 512.0, atol=8.0)


def test_the_strongest_features_are_kept_in_order(grey: np.ndarray) -> None:
    every, some = sift_features(grey, 100_000, 3200), sift_features(grey, 100, 3200)
    assert len(some.keypoints) == 100
    assert (np.diff(some.contrasts) <= 0).all()
    np.testing.assert_array_equal(some.contrasts, every.contrasts[:100])


def test_keypoints_of_a_smaller_image_are_in_pixels_of_the_whole(grey: np.ndarray) -> None:
    whole, half = sift_features(grey, 8192, 3200), sift_features(grey, 8192, max(grey.shape) // 2)
    mine, theirs = nearest(half, whole.keypoints)
    assert len(mine) > 0.4 * len(half.keypoints)
    offset = half.keypoints[mine, :2] - whole.keypoints[theirs, :2]
    np.testing.assert_allclose(np.median(offset, axis=0), 0.0, atol=0.05)
    assert half.keypoints[:, :2].max(axis=0)[0] > 0.8 * grey.shape[1]


def test_tiles_give_the_features_of_the_whole(grey: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sift_features(grey, 100_000, 3200)
    monkeypatch.setattr(sift, "MAX_PIXELS", grey.size // 3)
    monkeypatch.setattr(sift, "TILE", 160)
    tiled = sift_features(grey, 100_000, 3200)
    mine, theirs = nearest(tiled, whole.keypoints)
    assert len(tiled.keypoints) == pytest.approx(len(whole.keypoints), rel=0.1)
    assert len(np.unique(theirs)) > 0.9 * len(whole.keypoints)
    cosines = np.sum(tiled.descriptors[mine].astype(float) * whole.descriptors[theirs], axis=1) / 512.0**2
    assert np.quantile(cosines, 0.2) > 0.97
    fine = log2_scales(whole.keypoints[theirs]) < 1.2  # those of the tiles, wherever they are cut
    assert fine.sum() == pytest.approx(np.sum(log2_scales(whole.keypoints) < 1.2), abs=5)
    assert cosines[fine].min() > 0.99


def test_no_feature_lies_where_the_mask_is_black(grey: np.ndarray) -> None:
    mask = np.zeros(grey.shape, np.uint8)
    mask[:, : grey.shape[1] // 2] = 1
    found = sift_features(grey, 8192, 3200, mask)
    assert len(found.keypoints) > 0
    assert found.keypoints[:, 0].max() < grey.shape[1] // 2
    every = sift_features(grey, 8192, 3200)
    assert len(found.keypoints) == np.sum(every.keypoints[:, 0] < grey.shape[1] // 2)


def test_an_image_without_structure_has_no_features() -> None:
    found = sift_features(np.full((64, 80), 127, np.uint8), 8192, 3200)
    assert found.keypoints.shape == (0, 6)
    assert found.descriptors.shape == (0, 128)
