"""Shortlists hold the images that show the same, those of a sequence, and those near by position."""

import numpy as np
import pytest

from colmap_vg.features import shortlist
from colmap_vg.features.shortlist import aggregated, partners_of_partners, shared_partners, shortlisted


def places(num_places: int, views: int, seed: int) -> np.ndarray:
    """Descriptors (n, h, d) of views of places, those of one place in a row; two thirds of a view are of its place."""
    rng = np.random.default_rng(seed)

    def histograms(count: int) -> np.ndarray:
        shares = rng.gamma(0.3, size=(count, 128))
        return 512 * np.sqrt(shares / shares.sum(axis=1, keepdims=True))

    images = []
    for _ in range(num_places):
        own = histograms(60)
        for _ in range(views):
            seen = own[rng.permutation(60)[:40]] + rng.normal(0.0, 8.0, (40, 128))
            images.append(np.concatenate([seen, histograms(20)]))
    return np.clip(np.rint(images), 0, 255).astype(np.uint8)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shortlist, "MAX_ALL_IMAGES", 10)
    monkeypatch.setattr(shortlist, "SIMILAR_IMAGES", 6)
    monkeypatch.setattr(shortlist, "SEQUENCE_NEIGHBORS", 1)


@pytest.mark.usefixtures("small")
def test_small_folders_have_no_shortlist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shortlist, "SIMILAR_IMAGES", 1)
    near = shortlisted(places(2, 3, 0), np.full((6, 3), np.nan), 0)
    np.testing.assert_array_equal(near, ~np.eye(6, dtype=bool))


@pytest.mark.usefixtures("small")
def test_views_of_one_place_are_on_each_others_list() -> None:
    descriptors = places(12, 5, 1)
    order = np.random.default_rng(2).permutation(60)
    near = shortlisted(descriptors[order], np.full((60, 3), np.nan), 0)
    place = order // 5
    same = (place[:, None] == place) & ~np.eye(60, dtype=bool)
    assert near[same].mean() > 0.95
    assert near.sum() <= 2 * 60 * (6 + 1)
    np.testing.assert_array_equal(near, near.T)
    assert near[np.arange(59), np.arange(1, 60)].all()  # the sequence
    assert near[np.arange(58), np.arange(2, 60)].mean() < 0.5
    assert not near.diagonal().any()


@pytest.mark.usefixtures("small")
def test_neighbours_by_position_are_on_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shortlist, "GPS_NEIGHBORS", 2)
    monkeypatch.setattr(shortlist, "SIMILAR_IMAGES", 1)
    descriptors = places(30, 1, 3)
    positions = np.full((30, 3), np.nan)
    order = np.random.default_rng(4).permutation(20)
    positions[order] = np.arange(20)[:, None] * [10.0, 0.0, 0.0]
    near = shortlisted(descriptors, positions, 0)
    assert near[order[:-1], order[1:]].all()
    assert near[order[:-3], order[3:]].mean() < 0.5
    without = shortlisted(descriptors, np.full((30, 3), np.nan), 0)
    assert not without[order[:-1], order[1:]].all()


def test_words_and_vectors_depend_on_nothing_but_the_seed() -> None:
    descriptors = places(4, 3, 5)
    first = aggregated(descriptors, 1)
    np.testing.assert_array_equal(first, aggregated(descriptors, 1))
    assert not np.array_equal(first, aggregated(descriptors, 2))
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0, rtol=1e-5)


def test_images_without_features_are_similar_to_none() -> None:
    descriptors = places(3, 2, 6)
    descriptors[1] = 0
    vectors = aggregated(descriptors, 0)
    assert not vectors[1].any()
    assert not aggregated(np.zeros((3, 5, 128), np.uint8), 0).any()


def test_partners_of_partners_are_found_and_tried_ones_are_not() -> None:
    scores = np.zeros((5, 5))
    for first, second in ((0, 1), (1, 2), (3, 4)):
        scores[first, second] = scores[second, first] = 50.0
    tried = scores > 0
    found = partners_of_partners(scores, tried, 2)
    assert np.argwhere(np.triu(found)).tolist() == [[0, 2]]
    tried[0, 2] = tried[2, 0] = True
    assert not partners_of_partners(scores, tried, 2).any()


def star(num_leaves: int) -> np.ndarray:
    """Scores of pairs of the first image with each of the others, the higher the earlier it is."""
    scores = np.zeros((num_leaves + 1, num_leaves + 1))
    scores[0, 1:] = scores[1:, 0] = 10.0 * np.arange(num_leaves, 0, -1)
    return scores


def test_each_image_gets_its_best_partners_of_partners_and_no_more() -> None:
    scores = star(4)
    found = partners_of_partners(scores, scores > 0, 1)
    np.testing.assert_array_equal(found, found.T)
    assert np.argwhere(np.triu(found)).tolist() == [[1, 2], [1, 3], [1, 4]]


def test_a_shared_partner_of_all_says_less_than_one_of_two() -> None:
    of_all, of_two = star(6), star(2)
    assert shared_partners(np.minimum(of_all, 10.0))[1, 2] < 0.5 * shared_partners(np.minimum(of_two, 10.0))[1, 2]
