"""Pairs are chosen from synthetic features whose overlap is known, and from counts whose best pairs are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from colmap_vg.features.pair_selection import (
    MAX_PARTNERS,
    StrongestFeatures,
    num_strongest,
    pair_scores,
    preemptive_matches,
    select_pairs,
    strongest,
    strongest_features,
)


def random_descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """As SIFT's after L1-root normalisation: few large entries, norm 512."""
    root = np.sqrt(rng.gamma(0.5, size=(count, 128)))
    return np.rint(512 * root / np.linalg.norm(root, axis=1, keepdims=True)).astype(np.uint8)


def keypoints(rng: np.random.Generator, scales: np.ndarray, orientations: np.ndarray) -> np.ndarray:
    cosine, sine = scales * np.cos(orientations), scales * np.sin(orientations)
    xy = rng.uniform(0, 800, (2, len(scales)))
    return np.stack([*xy, cosine, -sine, sine, cosine], axis=1).astype(np.float32)


def street(num_images: int, seed: int, seen: int = 60, step: int = 15) -> StrongestFeatures:
    """Images along a street of features: image k sees those of numbers ``step k`` to ``step k + seen``, and noise."""
    rng = np.random.default_rng(seed)
    total = step * num_images + seen
    world, size, angle = random_descriptors(rng, total), rng.uniform(1, 3, total), rng.uniform(-np.pi, np.pi, total)
    points, descriptors = [], []
    for image in range(num_images):
        own = slice(step * image, step * image + seen)
        noisy = np.clip(world[own].astype(float) + rng.normal(0, 3, (seen, 128)), 0, 255).astype(np.uint8)
        turned, zoomed = rng.uniform(-np.pi, np.pi), rng.uniform(0.6, 1.6)
        clutter = random_descriptors(rng, 40)
        scales = np.concatenate([8 * zoomed * 2 ** size[own], rng.uniform(1, 60, 40)])
        orientations = np.concatenate([angle[own] + turned, rng.uniform(-np.pi, np.pi, 40)])
        points.append(keypoints(rng, scales, orientations))
        descriptors.append(np.concatenate([noisy, clutter]))
    return strongest_features(points, descriptors)


def test_the_strongest_are_the_largest_whatever_their_orientation() -> None:
    rng = np.random.default_rng(0)
    scales = rng.permutation(50) + 1.0
    chosen = strongest(keypoints(rng, scales, rng.uniform(-3, 3, 50)), 7)
    assert scales[chosen].tolist() == [50, 49, 48, 47, 46, 45, 44]


def test_pairs_that_overlap_have_matches_that_agree() -> None:
    matches, consistent = preemptive_matches(street(12, 2), 1)
    gap = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    assert (consistent <= matches).all()
    np.testing.assert_array_equal(matches, matches.T)
    assert consistent[gap == 1].min() >= 40  # 45 in common
    assert consistent[gap == 3].min() >= 10  # 15 in common
    assert consistent[gap > 3].max() <= 6


def test_matches_that_turn_every_way_count_for_little() -> None:
    rng = np.random.default_rng(3)
    shared, scales = random_descriptors(rng, 100), np.full(100, 5.0)
    points = [keypoints(rng, scales, rng.uniform(-np.pi, np.pi, 100)) for _ in range(2)]
    matches, consistent = preemptive_matches(strongest_features(points, [shared, shared]), 1)
    assert matches[0, 1] == 100
    assert consistent[0, 1] < 35


def test_one_turn_counts_in_full_wherever_the_bins_begin() -> None:
    rng = np.random.default_rng(7)
    shared, orientations = random_descriptors(rng, 60), rng.uniform(-np.pi, np.pi, 60)
    for turned in np.linspace(-np.pi, np.pi, 24, endpoint=False):
        both = (orientations, orientations + turned + rng.uniform(-0.1, 0.1, 60))
        scales = (np.full(60, 4.0), 4.0 * 2.0 ** rng.uniform(-0.1, 0.1, 60))
        points = [keypoints(rng, *own) for own in zip(scales, both, strict=True)]
        matches, consistent = preemptive_matches(strongest_features(points, [shared, shared]), 1)
        assert matches[0, 1] == consistent[0, 1] == 60


def test_the_result_does_not_depend_on_threads() -> None:
    features = street(10, 4)
    for one, many in zip(preemptive_matches(features, 1), preemptive_matches(features, 4), strict=True):
        np.testing.assert_array_equal(one, many)


def test_only_candidates_are_matched() -> None:
    features, candidates = street(10, 4), np.zeros((10, 10), dtype=bool)
    candidates[[2, 3, 4, 9], [3, 2, 9, 4]] = True
    every, some = preemptive_matches(features, 1), preemptive_matches(features, 1, candidates=candidates)
    for of_all, of_some in zip(every, some, strict=True):
        np.testing.assert_array_equal(of_some, np.where(candidates, of_all, 0))


def test_no_image_has_more_partners_than_are_of_use() -> None:
    n = 40
    matches = np.full((n, n), 100, np.int32)
    near = 100 - np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    chosen = select_pairs(matches, near.astype(np.int32), min_partners=2, max_partners=6)
    partners = np.bincount(chosen.ravel(), minlength=n)
    assert len(chosen) <= 6 * n
    assert partners.min() >= 3
    assert np.abs(chosen[:, 0] - chosen[:, 1]).max() <= 6  # the best are kept


def test_where_all_see_the_same_only_the_nearest_are_partners() -> None:
    n = MAX_PARTNERS + 40
    same = np.full((n, n), 100, np.int32)
    chosen = select_pairs(same, same)
    assert (chosen[:, 1] - chosen[:, 0]).max() == MAX_PARTNERS
    assert np.bincount(chosen.ravel()).min() >= MAX_PARTNERS


def test_images_with_few_or_no_features_do_no_harm() -> None:
    rng = np.random.default_rng(5)
    counts = (30, 0, 1, 30)
    shared = random_descriptors(rng, 30)
    points = [keypoints(rng, np.full(count, 4.0), np.zeros(count)) for count in counts]
    matches, consistent = preemptive_matches(strongest_features(points, [shared[:count] for count in counts]), 2)
    assert matches[0, 3] == consistent[0, 3] == 30
    assert not matches[1].any()
    assert len(select_pairs(matches, consistent, 1)) >= 3


def test_pairs_of_a_street_are_its_overlaps_and_few_others() -> None:
    counts = preemptive_matches(street(30, 6), 2)
    chosen = {(int(first), int(second)) for first, second in select_pairs(*counts, min_partners=2)}
    overlaps = {(i, j) for i in range(30) for j in range(i + 1, min(i + 4, 30))}
    assert overlaps <= chosen
    assert len(chosen - overlaps) <= 0.12 * 30 * 29 / 2


@st.composite
def symmetric_counts(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    n, seed = draw(st.integers(2, 25)), draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    matches = np.triu(rng.integers(0, draw(st.integers(1, 40)), (n, n)), 1)
    consistent = np.where(matches > 0, rng.integers(0, matches + 1), 0)
    return (matches + matches.T).astype(np.int32), (consistent + consistent.T).astype(np.int32)


@given(symmetric_counts(), st.integers(1, 6))
def test_every_image_keeps_its_best_and_all_are_connected(
    counts: tuple[np.ndarray, np.ndarray], min_partners: int
) -> None:
    matches, consistent = counts
    n = len(matches)
    pairs = select_pairs(matches, consistent, min_partners)
    scores = pair_scores(matches, consistent)
    assert scores[pairs[:, 0], pairs[:, 1]].sum() >= 0.979 * np.triu(scores).sum()
    chosen = np.zeros((n, n), dtype=bool)
    chosen[pairs[:, 0], pairs[:, 1]] = True
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert connected_components(chosen, directed=False)[0] == 1
    chosen |= chosen.T
    for image in range(n):
        others = [other for other in range(n) if other != image]
        best = sorted((scores[image, other] for other in others), reverse=True)[: min(min_partners, n - 1)]
        kept = sorted((scores[image, other] for other in others if chosen[image, other]), reverse=True)
        assert kept[: len(best)] == best


def test_third_images_speak_for_pairs_that_chance_left_out() -> None:
    """Four images that all see the same, but for one pair whose matches failed, and four others."""
    consistent = np.zeros((8, 8), np.int32)
    consistent[:4, :4] = consistent[4:, 4:] = 50
    np.fill_diagonal(consistent, 0)
    consistent[0, 1] = consistent[1, 0] = 0
    scores = pair_scores(consistent + 1 - np.eye(8, dtype=np.int32), consistent)
    assert scores[0, 1] > 10
    assert not scores[:4, 4:].any()
    assert scores[4, 5] > scores[0, 1]


def test_strongest_features_grow_with_the_features_within_limits() -> None:
    assert num_strongest([]) == num_strongest([50, 60]) == 300
    assert num_strongest([100, 4000, 9000]) == 500
    assert num_strongest([30000] * 3) == 1000


def test_groups_without_a_score_between_them_are_linked_once() -> None:
    consistent = np.zeros((10, 10), np.int32)
    consistent[:5, :5] = consistent[5:, 5:] = 50
    np.fill_diagonal(consistent, 0)
    pairs = select_pairs(consistent, consistent, 2).tolist()
    assert [pair for pair in pairs if (pair[0] < 5) != (pair[1] < 5)] == [[4, 5]]
    assert len(pairs) == 21


def test_images_without_anything_in_common_are_linked_in_their_order() -> None:
    nothing = np.zeros((6, 6), np.int32)
    assert select_pairs(nothing, nothing, 1).tolist() == [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]


@pytest.mark.parametrize("n", [0, 1])
def test_no_pair_without_two_images(n: int) -> None:
    assert select_pairs(np.zeros((n, n), np.int32), np.zeros((n, n), np.int32)).shape == (0, 2)
