"""Rigid components against the rank of the full rigidity matrix and known graphs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.graph.rigidity import largest_rigid_component, rigid_components


def _nullity(num_images: int, edges: np.ndarray) -> int:
    """Dimension of the motions that keep all directions at random positions, by dense SVD."""
    p = np.random.default_rng(99).standard_normal((num_images, 3))
    rows = []
    for i, j in edges:
        d = (p[j] - p[i]) / np.linalg.norm(p[j] - p[i])
        row = np.zeros((3, 3 * num_images))
        P = np.eye(3) - np.outer(d, d)
        row[:, 3 * i : 3 * i + 3], row[:, 3 * j : 3 * j + 3] = -P, P
        rows.append(row)
    singular = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    return 3 * num_images - int((singular > 1e-9).sum())


def _relabelled(labels: np.ndarray) -> list[tuple[int, ...]]:
    return sorted(tuple(np.flatnonzero(labels == k)) for k in np.unique(labels))


KNOWN = [
    ([(0, 1), (1, 2), (0, 2)], [(0, 1, 2)]),
    ([(0, 1), (1, 2), (0, 2), (2, 3)], [(0, 1, 2), (3,)]),
    ([(0, 1), (1, 2), (2, 3), (3, 0)], [(0, 1, 2, 3)]),  # a spatial 4-cycle is rigid by directions
    ([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (2, 4)], [(0, 1, 2), (3, 4, 5)]),  # two triangles at an articulation
    ([(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)], [(0,), (1,), (2,), (3,), (4,)]),
]


@pytest.mark.parametrize(("edges", "groups"), KNOWN)
def test_known_graphs(edges, groups):
    edges = np.array(edges)
    assert _relabelled(rigid_components(edges.max() + 1, edges)) == sorted(groups)


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 9), st.data())
def test_one_component_exactly_when_the_rigidity_matrix_has_nullity_four(num_images, data):
    pairs = [(i, j) for i in range(num_images) for j in range(i + 1, num_images)]
    chosen = data.draw(st.lists(st.sampled_from(pairs), min_size=1, max_size=2 * num_images, unique=True))
    edges = np.array(chosen)
    images, inside = largest_rigid_component(num_images, edges)
    rigid = inside.all() and images.all()
    assert rigid == (_nullity(num_images, edges) == 4)
    # Each component by itself is rigid.
    rows = np.flatnonzero(images)
    renumber = np.zeros(num_images, dtype=int)
    renumber[rows] = np.arange(len(rows))
    assert _nullity(len(rows), renumber[edges[inside]]) == 4


def test_image_hanging_on_one_edge_is_outside():
    ring = np.array([(i, (i + k) % 30) for i in range(30) for k in (1, 2)] + [(3, 30)])
    images, inside = largest_rigid_component(31, ring)
    assert images[:30].all()
    assert not images[30]
    assert inside.sum() == 60
