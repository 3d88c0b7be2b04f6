"""The nearest other solution: which image is turned, and by how much, in a case with a known second choice."""

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.rotations.alternatives import nearest_alternative


def _two_choices(num_images=8, seed=0):
    """All pairs exact, but for image 5, whose weaker half of edges would have it turned by `turn`."""
    rng = np.random.default_rng(seed)
    R = so3.random(num_images, rng)
    i, j = np.triu_indices(num_images, 1)
    edges = np.stack([i, j], axis=1)
    flipped = rng.random(len(edges)) < 0.5
    edges[flipped] = edges[flipped][:, ::-1]
    turn = so3.exp(np.radians([[0.0, 0.0, 70.0]]))[0]
    elsewhere = R.copy()
    elsewhere[5] = R[5] @ turn
    told = (edges == 5).any(axis=1) & np.isin(edges, [0, 1, 2]).any(axis=1)
    relative = np.where(
        told[:, None, None],
        elsewhere[edges[:, 1]] @ np.swapaxes(elsewhere[edges[:, 0]], 1, 2),
        R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2),
    )
    return R, edges, relative, np.where(told, 0.8, 1.0), turn


@pytest.mark.parametrize("seed", range(3))
def test_the_image_with_a_second_choice_is_turned_to_it(seed):
    R, edges, relative, weights, turn = _two_choices(seed=seed)
    found = nearest_alternative(8, edges, relative, weights, R, num_moved=1)
    moved = so3.angle(np.swapaxes(R, 1, 2) @ found)
    assert np.flatnonzero(moved > 1e-6).tolist() == [5]
    assert np.allclose(found[5], R[5] @ turn, atol=1e-9)


def test_images_without_a_second_choice_stay():
    R, edges, relative, weights, _ = _two_choices()
    exact = ~(edges == 5).any(axis=1)
    found = nearest_alternative(8, edges[exact], relative[exact], weights[exact], R, num_moved=3)
    assert so3.angle(np.swapaxes(R, 1, 2) @ found).max() < 1e-7
