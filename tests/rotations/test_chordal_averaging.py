"""Chordal averaging: known optima, finite differences, scipy's minimiser, invariances, the certificate."""

import itertools

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.rotations.certificate import certify_chordal
from colmap_vg.rotations.chordal import average_rotations_chordal
from colmap_vg.rotations.chordal_matrix import TangentQuadratic, chordal_cost, chordal_matrix
from colmap_vg.simulation.ring_scenes import ring_scene


def _problem(num_images, seed, sigma=0.1, num_neighbors=4):
    scene = ring_scene(num_images, num_neighbors, rotation_sigma=sigma, seed=seed)
    g = scene.graph
    weights = np.random.default_rng(seed).uniform(0.5, 2.0, g.num_edges)
    return g.edges, g.cam2_from_cam1_rotations, weights, scene.cam_from_world_rotations


def _plain_cost(edges, relative, weights, R):
    """The definition, an edge at a time."""
    return sum(w * np.sum((Q - R[j] @ R[i].T) ** 2) for (i, j), Q, w in zip(edges, relative, weights, strict=True))


def _gauge_free_error(R, truth):
    """Largest angle between rotations after the gauge of the first image is removed."""
    difference = np.swapaxes(truth, 1, 2) @ R
    return so3.angle(np.swapaxes(difference[:1], 1, 2) @ difference).max()


@pytest.mark.parametrize("num_images", [2, 3, 40, 400])
def test_noise_free_graphs_are_recovered(num_images):
    edges, relative, weights, truth = _problem(num_images, 3, sigma=0.0)
    result = average_rotations_chordal(num_images, edges, relative, weights)
    assert result.converged
    assert result.cost < 1e-22 * len(edges)
    assert _gauge_free_error(result.cam_from_world_rotations, truth) < 1e-12


def test_cost_gradient_and_hessian_against_finite_differences():
    edges, relative, weights, truth = _problem(7, 0, sigma=0.5)
    rng = np.random.default_rng(1)
    R = so3.perturbed(truth, 0.4, rng)
    assert chordal_cost(edges, relative, weights, R) == pytest.approx(_plain_cost(edges, relative, weights, R))
    model = TangentQuadratic(chordal_matrix(7, edges, relative, weights), R)
    v = rng.standard_normal((7, 3))

    def along(t):
        return _plain_cost(edges, relative, weights, R @ so3.exp(t * v))

    h = 1e-4
    assert np.sum(model.gradient * v) == pytest.approx((along(h) - along(-h)) / (2 * h), rel=1e-6)
    u = rng.standard_normal((7, 3))
    assert np.sum(model.hessian_times(v) * u) == pytest.approx(np.sum(model.hessian_times(u) * v), rel=1e-12)
    second = (along(h) - 2 * along(0.0) + along(-h)) / h**2
    assert np.sum(model.hessian_times(v) * v) == pytest.approx(second, rel=1e-5)


def test_the_optimum_is_scipys():
    edges, relative, weights, truth = _problem(8, 5, sigma=0.3)
    result = average_rotations_chordal(8, edges, relative, weights)
    found = scipy.optimize.minimize(
        lambda v: _plain_cost(edges, relative, weights, truth @ so3.exp(v.reshape(-1, 3))), np.zeros(24), tol=1e-12
    )
    assert result.cost == pytest.approx(found.fun, rel=1e-8)
    assert result.cost <= found.fun * (1 + 1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_gradient_vanishes_and_cost_falls_monotonically(seed):
    """From random starts on very noisy graphs, where full steps raise the cost in about every sixth run."""
    edges, relative, weights, _ = _problem(20, seed, sigma=1.0)
    for initial in (None, so3.random(20, np.random.default_rng(seed))):
        result = average_rotations_chordal(20, edges, relative, weights, initial)
        W = chordal_matrix(20, edges, relative, weights)
        assert np.abs(TangentQuadratic(W, result.cam_from_world_rotations).gradient).max() < 1e-10
        costs = np.array([entry.cost for entry in result.log])
        assert (np.diff(costs) <= 1e-13 * costs[:-1]).all()
        assert result.converged


def test_convergence_is_quadratic():
    edges, relative, weights, _ = _problem(60, 2, sigma=0.2)
    changes = [entry.change for entry in average_rotations_chordal(60, edges, relative, weights).log]
    late = [(a, b) for a, b in itertools.pairwise(changes) if a < 0.05]
    assert late
    assert all(b < 10 * a * a + 1e-14 for a, b in late)


@settings(max_examples=15, deadline=None)
@given(st.integers(5, 12), st.integers(0, 10_000))
def test_gauge_order_and_direction_of_edges_do_not_matter(num_images, seed):
    edges, relative, weights, _ = _problem(num_images, seed, sigma=0.1)
    rng = np.random.default_rng(seed)
    base = average_rotations_chordal(num_images, edges, relative, weights).cam_from_world_rotations
    label = rng.permutation(num_images)
    order = rng.permutation(len(edges))
    flip = rng.random(len(edges)) < 0.5
    new_edges = np.where(flip[:, None], edges[:, ::-1], edges)
    new_relative = np.where(flip[:, None, None], np.swapaxes(relative, 1, 2), relative)
    turn = so3.random(num_images, rng)  # other axes in each camera
    i, j = new_edges[order].T
    new_relative = turn[j] @ new_relative[order] @ np.swapaxes(turn[i], 1, 2)
    R = average_rotations_chordal(num_images, label[new_edges][order], new_relative, weights[order])
    back = np.swapaxes(turn, 1, 2) @ R.cam_from_world_rotations[label]
    assert _gauge_free_error(back, base) < 1e-9


def test_parallel_edges_count_as_their_sum():
    edges, relative, weights, _ = _problem(10, 1)
    twice = average_rotations_chordal(10, np.tile(edges, (2, 1)), np.tile(relative, (2, 1, 1)), np.tile(weights, 2))
    once = average_rotations_chordal(10, edges, relative, 2 * weights)
    assert twice.cost == pytest.approx(once.cost, rel=1e-12)


def test_same_bits_twice():
    edges, relative, weights, _ = _problem(40, 7)
    first, second = (average_rotations_chordal(40, edges, relative, weights) for _ in range(2))
    assert np.array_equal(first.cam_from_world_rotations, second.cam_from_world_rotations)


def test_disconnected_graph_is_named():
    R = np.tile(np.eye(3), (3, 1, 1))
    edges = np.array([[0, 1], [1, 2], [3, 4]])
    with pytest.raises(GraphError, match=r"2 components; image rows 3, 4 "):
        average_rotations_chordal(5, edges, R)
    with pytest.raises(GraphError, match="disconnected"):
        average_rotations_chordal(3, edges[:2], R[:2], weights=np.array([1.0, 0.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": np.array([[0, 1], [1, 5]])}, "rows 0 to 5 of 3 images"),
        ({"edges": np.array([[0, 1], [2, 2]])}, "edge 1 links image row 2 to itself"),
        ({"cam2_from_cam1_rotations": np.ones((1, 3, 3))}, "expected"),
        ({"weights": np.array([1.0, -1.0])}, "edge 1 has"),
        ({"weights": np.ones(3)}, "weights have shape"),
        ({"initial": np.ones((2, 3, 3))}, "initial rotations"),
        ({"num_images": 0}, "at least one image"),
    ],
)
def test_malformed_input_is_refused(change, message):
    good = {
        "num_images": 3,
        "edges": np.array([[0, 1], [1, 2]]),
        "cam2_from_cam1_rotations": np.tile(np.eye(3), (2, 1, 1)),
    }
    with pytest.raises(GraphError, match=message):
        average_rotations_chordal(**(good | change))


def test_one_image_has_the_identity():
    result = average_rotations_chordal(1, np.zeros((0, 2), dtype=int), np.zeros((0, 3, 3)))
    assert np.array_equal(result.cam_from_world_rotations, np.eye(3)[None])


def _twisted_cycle(num_images, turns):
    """A cycle whose relative rotations are the identity, and rotations that turn `turns` times around it."""
    edges = np.stack([np.arange(num_images), (np.arange(num_images) + 1) % num_images], axis=1)
    angle = 2 * np.pi * turns * np.arange(num_images) / num_images
    twisted = so3.exp(np.stack([0 * angle, 0 * angle, angle], axis=1))
    return edges, np.tile(np.eye(3), (num_images, 1, 1)), twisted


def test_certificate_tells_global_from_local():
    edges, relative, twisted = _twisted_cycle(12, 1)
    local = certify_chordal(12, edges, relative, twisted)
    assert local.stationarity < 1e-14  # the twisted cycle is a stationary point
    # One edge costs 2 * 2 (1 - cos(turn)).
    assert local.cost == pytest.approx(12 * 4 * (1 - np.cos(2 * np.pi / 12)))
    assert not local.is_global
    assert local.smallest_eigenvalue < -0.1
    assert local.lower_bound <= 0.0 < local.cost
    # f of the twisted cycle in closed form: S restricted to the turning plane is cos(t) (2 I) - A, so 2 cos(t) - 2.
    assert local.smallest_eigenvalue == pytest.approx(2 * np.cos(2 * np.pi / 12) - 2, rel=1e-9)
    best = average_rotations_chordal(12, edges, relative)
    proven = certify_chordal(12, edges, relative, best.cam_from_world_rotations)
    assert proven.is_global
    assert abs(proven.smallest_eigenvalue) < 1e-12


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 0.4))
def test_certificate_bounds_every_other_choice(seed, away):
    edges, relative, weights, _ = _problem(8, seed, sigma=0.2)
    rng = np.random.default_rng(seed)
    optimum = average_rotations_chordal(8, edges, relative, weights)
    there = so3.perturbed(optimum.cam_from_world_rotations, away, rng)
    certificate = certify_chordal(8, edges, relative, there, weights)
    assert certificate.lower_bound <= optimum.cost + 1e-9
    at_best = certify_chordal(8, edges, relative, optimum.cam_from_world_rotations, weights)
    assert at_best.is_global
    assert at_best.relative_gap < 1e-9


def test_certificate_eigenvalue_is_the_dense_one():
    edges, relative, weights, _ = _problem(50, 3, sigma=0.2)
    R = so3.random(50, np.random.default_rng(0))
    certificate = certify_chordal(50, edges, relative, R, weights)
    W = chordal_matrix(50, edges, relative, weights).toarray()
    S = -W
    for k in range(50):
        block = W[3 * k : 3 * k + 3] @ R.reshape(-1, 3) @ R[k].T
        S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += 0.5 * (block + block.T)
    assert certificate.smallest_eigenvalue == pytest.approx(np.linalg.eigvalsh(S)[0], rel=1e-8)
    with pytest.raises(GraphError, match="needs the rotations"):
        certify_chordal(50, edges, relative, None, weights)
