"""The first look at the largest features: who overlaps, whatever the threads and the turn of the camera."""

from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rendered_corner import render_corner, write_jpeg

from colmap_vg.features import extraction
from colmap_vg.features.extraction import extract_and_match
from colmap_vg.features.pair_selection import LargestFeatures, all_votes, largest_features, promising_pairs
from colmap_vg.options import FeatureOptions
from colmap_vg.stages import StageLog


def along_a_wall(num_images: int, *, num_features: int = 120, seen: int = 80, seed: int = 0) -> LargestFeatures:
    """Images that look at a wall of features; each sees a window, and each next one half of what its neighbour saw."""
    rng = np.random.default_rng(seed)
    wall = rng.standard_normal((num_images * seen // 2 + seen, 128))
    turn, scale = rng.uniform(0, 2 * np.pi, len(wall)), rng.normal(0, 1, len(wall))
    descriptors, turns, scales = [], [], []
    for k in range(num_images):
        window = slice(k * seen // 2, k * seen // 2 + seen)
        other = rng.standard_normal((num_features - seen, 128))
        own = np.concatenate([wall[window] + 0.1 * rng.standard_normal((seen, 128)), other])
        camera_turn, camera_scale = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.5)
        random = np.stack([rng.uniform(0, 2 * np.pi, len(other)), rng.normal(0, 1, len(other))])
        order = rng.permutation(num_features)
        descriptors.append((own / np.linalg.norm(own, axis=1, keepdims=True))[order])
        turns.append(np.concatenate([turn[window] + camera_turn, random[0]])[order])
        scales.append(np.concatenate([scale[window] + camera_scale, random[1]])[order])
    arrays = [np.array(a, dtype=np.float32) for a in (descriptors, turns, scales)]
    return LargestFeatures(np.arange(num_images) + 10, *arrays)


def test_pairs_that_overlap_are_found_and_no_others() -> None:
    features = along_a_wall(40)
    pairs = promising_pairs(features, 2, partners=0)
    assert pairs.tolist() == [[k + 10, k + 11] for k in range(39)]


def test_every_image_keeps_its_best_partners() -> None:
    features = along_a_wall(40)
    pairs = promising_pairs(features, 2, min_votes=10**6, partners=2)
    degree = np.bincount(pairs.ravel() - 10, minlength=40)
    assert degree.min() >= 2
    wanted = {(k + 10, k + 11) for k in range(39)}
    assert wanted <= set(map(tuple, pairs.tolist()))


def test_threads_and_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    features = along_a_wall(21, seed=3)
    votes = all_votes(features, 1)
    np.testing.assert_array_equal(votes, votes.T)
    np.testing.assert_array_equal(votes, all_votes(features, 3))
    monkeypatch.setattr("colmap_vg.features.pair_selection.IMAGES_PER_BLOCK", 5)
    np.testing.assert_array_equal(votes, all_votes(features, 2))


def test_chance_matches_get_no_votes_for_one_turn_in_common() -> None:
    features = along_a_wall(2)
    rng = np.random.default_rng(0)
    scattered = LargestFeatures(
        features.image_ids,
        features.descriptors,
        rng.uniform(0, 2 * np.pi, features.turns.shape).astype(np.float32),
        features.log_scales,
    )
    assert all_votes(scattered, 1)[0, 1] < 0.5 * all_votes(features, 1)[0, 1]


def test_selected_matching_matches_what_overlaps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    corner = render_corner(4)
    (tmp_path / "images").mkdir()
    for k, image in enumerate(corner.images):
        write_jpeg(tmp_path / "images" / f"{k}.jpg", image)
    noise = np.random.default_rng(0).integers(0, 255, corner.images[0].shape).astype(np.uint8)
    write_jpeg(tmp_path / "images" / "noise.jpg", noise)
    monkeypatch.setattr(extraction, "promising_pairs", partial(promising_pairs, partners=1))
    monkeypatch.setattr(extraction, "MAX_EXHAUSTIVE", 4)
    log = StageLog()
    result = extract_and_match(tmp_path / "images", tmp_path / "a.db", FeatureOptions(num_threads=2), log)
    exhaustive = extract_and_match(
        tmp_path / "images", tmp_path / "b.db", FeatureOptions(num_threads=2, matching="exhaustive")
    )
    assert result.num_verified_pairs >= exhaustive.num_verified_pairs - 1 >= 4
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        assert database.num_matched_image_pairs() < 10
    features = largest_features(tmp_path / "a.db")
    assert features.descriptors.shape[0] == 5
    np.testing.assert_allclose(np.linalg.norm(features.descriptors[0], axis=1), 1.0, rtol=1e-5)


def test_names_with_spaces_are_matched_all(tmp_path: Path) -> None:
    corner = render_corner(3)
    (tmp_path / "images").mkdir()
    for k, image in enumerate(corner.images):
        write_jpeg(tmp_path / "images" / f"photo {k}.jpg", image)
    log = StageLog()
    options = FeatureOptions(num_threads=2, matching="selected", max_num_features=500)
    assert extract_and_match(tmp_path / "images", tmp_path / "a.db", options, log).num_verified_pairs >= 2
    assert any("spaces" in warning for warning in log.warnings)
