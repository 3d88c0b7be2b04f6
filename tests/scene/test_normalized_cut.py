"""The cut of least conductance against all cuts of small graphs, and on large ones."""

from itertools import combinations

import numpy as np
import pytest

from colmap_vg.scene.normalized_cut import normalized_cut


def conductance(side: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> float:
    i, j = edges.T
    degree = np.bincount(i, weights, len(side)) + np.bincount(j, weights, len(side))
    cut = weights[side[i] != side[j]].sum()
    return float(cut / min(degree[side].sum(), degree[~side].sum()))


@pytest.mark.parametrize("seed", range(8))
def test_conductance_is_that_of_the_cut_and_near_the_least(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 9
    edges = np.array([(i, j) for i, j in combinations(range(n), 2) if j == i + 1 or rng.random() < 0.4])
    weights = rng.uniform(0.1, 1.0, len(edges))
    side, found = normalized_cut(n, edges, weights)
    assert found == pytest.approx(conductance(side, edges, weights))
    assert side.sum() <= n - side.sum()
    sides = (np.isin(np.arange(n), chosen) for k in range(1, n // 2 + 1) for chosen in combinations(range(n), k))
    least = min(conductance(s, edges, weights) for s in sides)
    # Cheeger's inequality bounds the sweep's cut.
    assert least - 1e-12 <= found <= 2.0 * np.sqrt(least)


@pytest.mark.parametrize("size", [10, 300])
def test_two_clusters_come_apart(size: int) -> None:
    rng = np.random.default_rng(0)
    within = [
        (a, a + k) for half in (0, size) for a in range(half, half + size) for k in (1, 2, 3) if a + k < half + size
    ]
    edges = np.array([*within, (size - 1, size), (2, size + 5)])
    shuffled = rng.permutation(2 * size)
    side, found = normalized_cut(2 * size, shuffled[edges], np.ones(len(edges)))
    assert set(np.flatnonzero(side)) in (set(shuffled[:size]), set(shuffled[size:]))
    assert found == pytest.approx(2.0 / (2 * (len(within) // 2) + 2))


def test_sides_have_the_least_size_that_is_asked() -> None:
    star = np.array([(0, k) for k in range(1, 8)])
    side, _ = normalized_cut(8, star, np.ones(7), min_nodes=3)
    assert side.sum() >= 3
