"""Rigid components against the rank of the full rigidity matrix and known graphs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.solver.rigidity import largest_rigid_component, rigid_components


def _nullity(num_images: int, edges: np.ndarray, ratios: np.ndarray | None = None) -> int:
    """Dimension of the motions that keep all directions, and ratios of lengths, at random positions, by dense SVD."""
    p = np.random.default_rng(99).standard_normal((num_images, 3))
    rows = []
    for i, j in edges:
        d = (p[j] - p[i]) / np.linalg.norm(p[j] - p[i])
        row = np.zeros((3, 3 * num_images))
        P = np.eye(3) - np.outer(d, d)
        row[:, 3 * i : 3 * i + 3], row[:, 3 * j : 3 * j + 3] = -P, P
        rows.append(row)
    for pair in np.zeros((0, 2), dtype=int) if ratios is None else ratios:
        row = np.zeros((1, 3 * num_images))
        for sign, (i, j) in zip((1.0, -1.0), edges[pair], strict=True):
            # Of log |p_j - p_i|: a change of the one's length is that of the other's.
            d = (p[j] - p[i]) / np.sum((p[j] - p[i]) ** 2)
            row[0, 3 * i : 3 * i + 3] -= sign * d
            row[0, 3 * j : 3 * j + 3] += sign * d
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


@settings(max_examples=100, deadline=None)
@given(st.integers(3, 9), st.data())
def test_known_ratios_fix_what_the_rank_of_the_full_system_says(num_images, data):
    pairs = [(i, j) for i in range(num_images) for j in range(i + 1, num_images)]
    edges = np.array(data.draw(st.lists(st.sampled_from(pairs), min_size=2, max_size=2 * num_images, unique=True)))
    meeting = [(a, b) for a in range(len(edges)) for b in range(a) if set(edges[a]) & set(edges[b])]
    chosen = data.draw(st.lists(st.sampled_from(meeting), max_size=num_images, unique=True)) if meeting else []
    ratios = np.array(chosen, dtype=np.int64).reshape(-1, 2)
    images, inside = largest_rigid_component(num_images, edges, 0, ratios)
    assert (inside.all() and images.all()) == (_nullity(num_images, edges, ratios) == 4)


def test_a_chain_is_fixed_up_to_where_a_ratio_is_missing():
    chain = np.array([(k, k + 1) for k in range(8)])
    ratios = np.array([(k, k + 1) for k in range(7) if k != 4])
    assert not largest_rigid_component(9, chain)[0].all()
    assert _relabelled(rigid_components(9, chain, 0, ratios)) == [(0, 1, 2, 3, 4), (5, 6, 7)]
    assert largest_rigid_component(9, chain, 0, np.array([(k, k + 1) for k in range(7)]))[0].all()


def test_image_hanging_on_one_edge_is_outside():
    ring = np.array([(i, (i + k) % 30) for i in range(30) for k in (1, 2)] + [(3, 30)])
    images, inside = largest_rigid_component(31, ring)
    assert images[:30].all()
    assert not images[30]
    assert inside.sum() == 60
