"""Matches of descriptors beside brute force without blocks, bundles or float products."""

from collections.abc import Callable

import numpy as np
import pytest

from colmap_vg.features import nearest_descriptors
from colmap_vg.features.nearest_descriptors import (
    MAX_EPIPOLAR_RATIO,
    MAX_RATIO,
    MAX_SQUARED_DISTANCE,
    MAX_WINDOW_RATIO,
    Nearest,
    epipolar_matches,
    homography_matches,
    more_mutual_matches,
    mutual_matches,
)


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Root-normalised random histograms, as bytes of norm 512."""
    shares = rng.gamma(0.3, size=(count, 128))
    return np.rint(512 * np.sqrt(shares / shares.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)


def disturbed(rng: np.random.Generator, original: np.ndarray, size: int) -> np.ndarray:
    return (original.astype(int) + rng.integers(-size, size + 1, original.shape)).clip(0, 255).astype(np.uint8)


def by_brute_force(first: np.ndarray, second: np.ndarray, allowed: np.ndarray, ratio: float, both_ways: bool) -> set:
    squared = 2.0 - 2.0 * (first.astype(int) @ second.astype(int).T) / 512.0**2
    squared[~allowed] = 2.0
    distances = np.maximum(squared, 0.0)
    found = set()
    for i, row in enumerate(squared):
        j = int(row.argmin())
        near = distances[i, j]
        good = squared[:, j].argmin() == i and near < ratio**2 * np.sort(distances[i])[1]
        good &= near <= MAX_SQUARED_DISTANCE
        if good and (not both_ways or near < ratio**2 * np.sort(distances[:, j])[1]):
            found.add((i, j))
    return found


def similar_sets(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    first = descriptors(rng, 700)
    second = np.concatenate([disturbed(rng, first[:400], 25), descriptors(rng, 350)])
    second[10:30] = disturbed(rng, first[10:30], 60)
    second[400:420] = disturbed(rng, first[:20], 28)  # look-alikes that the ratio test turns down
    return first, second[rng.permutation(len(second))]


@pytest.mark.parametrize("seed", range(3))
def test_mutual_matches_are_those_of_brute_force(seed: int) -> None:
    first, second = similar_sets(seed)
    everywhere = np.ones((len(first), len(second)), dtype=bool)
    expected = by_brute_force(first, second, everywhere, MAX_RATIO, both_ways=True)
    found = {tuple(row) for row in mutual_matches(first, second).tolist()}
    assert found == expected
    assert 300 < len(found) < 420
    assert {(b, a) for a, b in mutual_matches(second, first).tolist()} == found


@pytest.mark.parametrize(("leading1", "leading2"), [(0, 0), (7, 300), (300, 7), (450, 500)])
def test_matching_goes_on_from_the_leading_descriptors(
    leading1: int, leading2: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = similar_sets(5)
    at_once, every = more_mutual_matches(first, second, None)
    _, known = more_mutual_matches(first[:leading1], second[:leading2], None)
    compare, counted = Nearest.compare, []

    def counting(best: Nearest, rows: np.ndarray, columns: np.ndarray, products: np.ndarray) -> None:
        counted.append(products.size)
        compare(best, rows, columns, products)

    monkeypatch.setattr(Nearest, "compare", counting)
    matches, nearest = more_mutual_matches(first, second, known)
    np.testing.assert_array_equal(matches, at_once)
    for name in ("_nearest", "_first", "_second", "_first_of_2"):
        np.testing.assert_array_equal(getattr(nearest, name), getattr(every, name))
    assert sum(counted) == len(first) * len(second) - leading1 * leading2


@pytest.mark.parametrize("inside", [False, True], ids=["epipole outside", "epipole inside"])
def test_epipolar_matches_are_those_of_brute_force_near_lines(inside: bool) -> None:
    rng = np.random.default_rng(5)
    first, second = similar_sets(7)
    K = np.array([[900.0, 0.0, 500.0], [0.0, 900.0, 400.0], [0.0, 0.0, 1.0]])
    t = np.array([0.1, -0.05, 1.0]) if inside else np.array([1.0, 0.2, 0.1])
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    angle = 0.1
    R = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    points1 = rng.uniform([0.0, 0.0], [1000.0, 800.0], (len(first), 2))
    points2 = rng.uniform([0.0, 0.0], [1000.0, 800.0], (len(second), 2))
    lines = np.concatenate([points1, np.ones((len(points1), 1))], axis=1) @ F.T
    # Half of the features of image 2 lie on the line of the feature that they resemble.
    nearest = (first.astype(int) @ second.astype(int).T).argmax(axis=0)
    on_line = rng.random(len(second)) < 0.5
    normal = lines[nearest[on_line]]
    off = (normal[:, :2] * points2[on_line]).sum(axis=1) + normal[:, 2]
    points2[on_line] -= (off / np.square(normal[:, :2]).sum(axis=1))[:, None] * normal[:, :2]
    distances = np.abs(lines[:, :2] @ points2.T + lines[:, 2:]) / np.hypot(lines[:, :1], lines[:, 1:2])
    expected = by_brute_force(first, second, distances <= 3.0, MAX_EPIPOLAR_RATIO, both_ways=False)
    found = {tuple(row) for row in epipolar_matches(F, points1, points2, first, second, 3.0).tolist()}
    assert found == expected
    assert len(found) > 150
    scaled = epipolar_matches(-3.0 * F / 7.0, points1, points2, first, second, 3.0)
    assert {tuple(row) for row in scaled.tolist()} == found


def test_homography_matches_are_those_of_brute_force_near_predicted_places() -> None:
    rng = np.random.default_rng(8)
    first, second = similar_sets(9)
    H = np.array([[0.9, 0.1, 30.0], [-0.05, 1.1, -20.0], [1e-4, -5e-5, 1.0]])
    points1 = rng.uniform([0.0, 0.0], [1000.0, 800.0], (len(first), 2))
    taken = np.concatenate([points1, np.ones((len(points1), 1))], axis=1) @ H.T
    predicted = taken[:, :2] / taken[:, 2:]
    points2 = rng.uniform([0.0, 0.0], [1000.0, 800.0], (len(second), 2))
    nearest = (first.astype(int) @ second.astype(int).T).argmax(axis=0)
    moved = rng.random(len(second)) < 0.6
    points2[moved] = predicted[nearest[moved]] + rng.uniform(-60.0, 60.0, (moved.sum(), 2))
    allowed = (np.abs(predicted[:, None] - points2[None]) <= 50.0).all(axis=2)
    expected = by_brute_force(first, second, allowed, MAX_WINDOW_RATIO, both_ways=False)
    found = {tuple(row) for row in homography_matches(-2.0 * H, points1, points2, first, second, 50.0).tolist()}
    assert found == expected
    assert len(found) > 100


def compared_share(monkeypatch: pytest.MonkeyPatch, num1: int, num2: int) -> Callable[[], float]:
    """Share of the pairs of features whose descriptors have been compared."""
    compare, sizes = nearest_descriptors.Nearest.compare, []

    def counted(self: object, rows: np.ndarray, columns: np.ndarray, products: np.ndarray) -> None:
        sizes.append(products.size)
        compare(self, rows, columns, products)

    monkeypatch.setattr(nearest_descriptors.Nearest, "compare", counted)
    return lambda: sum(sizes) / (num1 * num2)


def test_few_descriptors_are_compared_where_lines_or_places_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    first, second = similar_sets(2)
    points1, points2 = (rng.uniform([0.0, 0.0], [1000.0, 800.0], (len(own), 2)) for own in (first, second))
    sideways = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    with monkeypatch.context() as patch:
        share = compared_share(patch, len(first), len(second))
        epipolar_matches(sideways, points1, points2, first, second, 2.0)
        assert share() < 0.06
    with monkeypatch.context() as patch:
        share = compared_share(patch, len(first), len(second))
        homography_matches(np.eye(3), points1, points2, first, second, 30.0)
        assert share() < 0.06


def test_lines_at_the_cut_of_their_angles_are_no_exception() -> None:
    rng = np.random.default_rng(1)
    first = descriptors(rng, 120)
    second = disturbed(rng, first, 10)
    everything = [[row, row] for row in range(120)]
    for _ in range(20):
        # The epipole of image 2 is amid the features, so that lines of all angles have some.
        F = np.cross(np.eye(3), [*rng.uniform(-0.3, 0.3, 2), 1.0]) @ rng.standard_normal((3, 3))
        points1, points2 = rng.uniform(-1.0, 1.0, (2, 120, 2))
        lines = np.concatenate([points1, np.ones((120, 1))], axis=1) @ F.T
        lines /= np.hypot(lines[:, 0], lines[:, 1])[:, None]
        off = (lines[:, :2] * points2).sum(axis=1) + lines[:, 2] + rng.uniform(-0.009, 0.009, 120)
        points2 -= off[:, None] * lines[:, :2]
        assert epipolar_matches(F, points1, points2, first, second, 0.01).tolist() == everything


def test_copies_are_ambiguous_whatever_their_norm() -> None:
    rng = np.random.default_rng(3)
    first = descriptors(rng, 200)
    first[:, 0] += 40  # of norms above 512
    second = np.concatenate([first, first[:50]])
    assert mutual_matches(first, second)[:, 0].tolist() == list(range(50, 200))


def test_nothing_matches_nothing() -> None:
    none, some = np.empty((0, 128), np.uint8), descriptors(np.random.default_rng(0), 5)
    for first, second in ((none, none), (none, some), (some, none)):
        assert mutual_matches(first, second).shape == (0, 2)
        points1, points2 = np.ones((len(first), 2)), np.ones((len(second), 2))
        assert epipolar_matches(np.eye(3), points1, points2, first, second, 2.0).shape == (0, 2)
        assert homography_matches(np.eye(3), points1, points2, first, second, 2.0).shape == (0, 2)
    assert len(mutual_matches(some, some[:1])) == 1
