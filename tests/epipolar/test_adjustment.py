"""Epipolar adjustment: derivatives, exact recovery, focal lengths, gauge, reversed edges, an independent optimum."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from colmap_vg.epipolar import adjustment
from colmap_vg.epipolar.adjustment import adjust_epipolar, cost_and_gradient
from colmap_vg.epipolar.cameras import Cameras, gauged
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.epipolar.triplets import find_triplets
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.simulation.ring_scenes import nearest_neighbor_edges, ring_cameras


def scene(seed, *, num_images=8, num_matches=40, sigma_px=0.0, focal=1000.0, wrong=1.0, num_cameras=2, free=False):
    """Rays in a ring of cameras, taken with `wrong` times the true focal length; and the true cameras."""
    rng = np.random.default_rng(seed)
    R, p = ring_cameras(num_images, rng)
    edges = nearest_neighbor_edges(p, 4)
    camera = np.arange(num_images) % num_cameras
    points = rng.uniform(-1, 1, (len(edges), num_matches, 3))
    rays = []
    for side in (0, 1):
        local = np.einsum("mab,mkb->mka", R[edges[:, side]], points - p[edges[:, side], None])
        pixels = focal * local[..., :2] / local[..., 2:] + sigma_px * rng.standard_normal((*points.shape[:2], 2))
        plane = np.concatenate([pixels / (focal * wrong), np.ones((*pixels.shape[:2], 1))], axis=2)
        rays.append(normalized(plane).reshape(-1, 3))
    problem = EpipolarProblem(
        num_images,
        edges,
        num_matches * np.arange(len(edges) + 1),
        *rays,
        camera,
        np.full(num_cameras, focal * wrong),
        np.full(num_cameras, free),
    )
    return problem, R, gauged(p)


def directions_of(problem, R, p):
    return Cameras(R, p, Lenses(np.zeros(2))).relative(problem.edges)[1]


def with_triplets(problem, R, p, points, *, sigma_px=0.0, seed=0):
    """The same cameras with given points that all images see, and the triplets that share them."""
    rng = np.random.default_rng(seed)
    n, k, edges = len(R), len(points), problem.edges
    local = np.einsum("nab,nkb->nka", R, points[None] - p[:, None])
    plane = local / local[..., 2:]
    plane[..., :2] += sigma_px / problem.focal_lengths[0] * rng.standard_normal((n, k, 2))
    rays = normalized(plane)
    keypoints = np.tile(np.arange(k, dtype=np.int32), len(edges))
    offsets, rays1, rays2 = k * np.arange(len(edges) + 1), *(rays[edges[:, s]].reshape(-1, 3) for s in (0, 1))
    i, j = edges.T
    triplets = find_triplets(edges, offsets, keypoints, keypoints, rays1, rays2, R[j] @ np.swapaxes(R[i], 1, 2), 60)
    return replace(problem, offsets=offsets, bearings1=rays1, bearings2=rays2, triplets=triplets)


def disturbed(R, p, seed, amount):
    rng = np.random.default_rng(seed)
    return so3.exp(amount * rng.standard_normal((len(R), 3))) @ R, p + amount * rng.standard_normal(p.shape)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("free", "term"),
    [(False, None), (False, -0.2), (True, None), (True, 0.0), (True, -0.2), (True, 0.1)],
)
def test_gradient_is_that_of_finite_differences(free, term, shared):
    problem, R, p = scene(1, sigma_px=1.0, free=free)
    if term is not None:
        problem = replace(problem, bent_cameras=np.array([True, False]))
    if shared:
        points = np.random.default_rng(3).uniform(-0.3, 0.3, (25, 3))
        problem = with_triplets(problem, R, p, points, sigma_px=1.0)
        assert len(problem.triplets.images) > len(R)
    R, p = disturbed(R, p, 2, 0.02)
    at = Cameras(R, gauged(p), Lenses(np.array([0.05, -0.03]) if free else np.zeros(2), term or 0.0))
    size = 6 * len(R) + ((2 if term is None else 3) if free else 0)  # a term is held where focal lengths are
    _, gradient = cost_and_gradient(problem, at, 3.0)
    assert gradient.shape == (size,)
    rng = np.random.default_rng(0)
    for step in (*np.eye(size)[:: 5 if free else 7], *np.eye(size)[-2:], *rng.standard_normal((3, size))):
        step = 1e-6 * step / np.linalg.norm(step)
        (ahead, _), (behind, _) = (
            cost_and_gradient(problem, at.moved(sign * step, np.flatnonzero(problem.free_focals)), 3.0)
            for sign in (1, -1)
        )
        slope = (ahead - behind) / 2.0
        assert slope == pytest.approx(gradient @ step, rel=1e-4, abs=1e-5 * np.abs(gradient).max() * 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_give_exact_cameras(seed):
    problem, R, p = scene(seed)
    start = disturbed(R, p, seed, 0.03)
    found = adjust_epipolar(problem, *start, directions_of(problem, R, p), tolerance=1e-12)
    errors, similarity = align_positions(found.projection_centers, p)
    assert errors.max() < 1e-8
    turned = found.cam_from_world_rotations @ similarity.rotation.T
    assert so3.angle(turned @ np.swapaxes(R, 1, 2)).max() < 1e-8
    assert found.converged
    assert not found.reversed_edges.any()


@pytest.mark.parametrize("wrong", [0.9, 1.1])
def test_focal_lengths_are_found_with_the_poses(wrong):
    problem, R, p = scene(4, num_images=12, num_matches=80, sigma_px=0.3, wrong=wrong, free=True)
    start = disturbed(R, p, 5, 0.02)
    found = adjust_epipolar(problem, *start, directions_of(problem, R, p))
    np.testing.assert_allclose(found.focal_scales * wrong, 1.0, atol=0.01)
    assert align_positions(found.projection_centers, p)[0].max() < 0.01
    held = adjust_epipolar(replace(problem, free_focals=np.zeros(2, bool)), *start, directions_of(problem, R, p))
    assert held.cost > 1.5 * found.cost
    np.testing.assert_array_equal(held.focal_scales, 1.0)


def test_cost_falls_from_step_to_step_of_a_scale():
    problem, R, p = scene(6, sigma_px=1.0)
    found = adjust_epipolar(problem, *disturbed(R, p, 6, 0.05), directions_of(problem, R, p))
    assert len(found.log) > 3
    for before, after in pairwise(found.log):
        assert after.iteration == 1 or after.cost < before.cost


def test_world_frame_and_scale_change_nothing_but_the_frame():
    problem, R, p = scene(7, sigma_px=0.5)
    R0, p0 = disturbed(R, p, 7, 0.03)
    turn = so3.exp(np.array([[0.4, -1.0, 2.0]]))[0]
    directions = directions_of(problem, R, p)
    # Where a scale's minimum is called reached depends on the frame's axes, and so does the noise found there: fix it.
    one, two = (
        adjust_epipolar(problem, *cameras, directions, scales_px=(8.0, 2.0, 1.0), final_sigmas=0.0)
        for cameras in ((R0, p0), (R0 @ turn.T, 5.0 * p0 @ turn.T + 3.0))
    )
    assert two.cost == pytest.approx(one.cost, rel=1e-6)
    assert align_positions(two.projection_centers, one.projection_centers)[0].max() < 1e-4


def test_reversed_edges_are_dropped_and_named():
    problem, R, p = scene(8, sigma_px=0.5)
    directions = directions_of(problem, R, p)
    directions[3] *= -1.0
    found = adjust_epipolar(problem, *disturbed(R, p, 8, 0.02), directions)
    assert np.flatnonzero(found.reversed_edges).tolist() == [3]
    without = problem.without(found.reversed_edges)
    assert len(without.edges) == len(problem.edges) - 1
    np.testing.assert_array_equal(without.bearings1[:120], problem.bearings1[:120])
    np.testing.assert_array_equal(without.bearings1[120:], problem.bearings1[160:])


def test_coinciding_cameras_keep_everything_finite():
    problem, R, p = scene(9, sigma_px=0.5)
    i, j = problem.edges[0]
    p = p.copy()
    p[j] = p[i]
    found = adjust_epipolar(problem, R, p, directions_of(problem, R, p))
    assert np.isfinite(found.projection_centers).all()
    assert np.isfinite(found.cost)


def test_false_pairs_move_the_cameras_little():
    problem, R, p = scene(10, num_images=12, sigma_px=0.5)
    clean = adjust_epipolar(problem, *disturbed(R, p, 1, 0.02), directions_of(problem, R, p))
    rng = np.random.default_rng(0)
    bearings = problem.bearings2.copy()
    for edge in (4, 17):
        rows = slice(problem.offsets[edge], problem.offsets[edge + 1])
        bearings[rows] = normalized(bearings[rows] + rng.normal(0, 0.15, (40, 3)))
    false = adjust_epipolar(
        replace(problem, bearings2=bearings), *disturbed(R, p, 1, 0.02), directions_of(problem, R, p)
    )
    clean_error, false_error = (align_positions(f.projection_centers, p)[0].mean() for f in (clean, false))
    assert false_error < 1.5 * clean_error


def test_minimum_is_that_of_a_general_solver():
    problem, R, p = scene(11, num_images=5, num_matches=15, sigma_px=1.0)
    start = disturbed(R, p, 11, 0.01)
    found = adjust_epipolar(
        problem, *start, directions_of(problem, R, p), scales_px=(1.0,), final_sigmas=0.0, tolerance=1e-13
    )
    edge = np.repeat(np.arange(len(problem.edges)), np.diff(problem.offsets))
    i, j = problem.edges[edge].T

    def residuals(x):
        turns, centers = x[:15].reshape(5, 3), x[15:].reshape(5, 3)
        rotations = so3.exp(turns) @ R
        relative = rotations[j] @ np.swapaxes(rotations[i], 1, 2)
        d = normalized(np.einsum("kab,kb->ka", rotations[i], centers[j] - centers[i]))
        x1, x2 = problem.bearings1, problem.bearings2
        line2 = np.einsum("kab,kb->ka", relative, np.cross(d, x1))
        line1 = np.cross(np.einsum("kba,kb->ka", relative, x2), d)
        c = np.einsum("ka,ka->k", x2, line2)
        s = np.sqrt(np.sum(line2**2, axis=1) + np.sum(line1**2, axis=1) - 2 * c**2) / 1000.0
        return c / s

    x0 = np.concatenate([np.zeros(15), p.ravel()])
    reference = least_squares(residuals, x0, loss="cauchy", f_scale=1.0, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert found.cost == pytest.approx(2.0 * reference.cost, rel=1e-8)


def test_nothing_to_adjust_is_an_error():
    problem, R, p = scene(12)
    empty = problem.without(np.ones(len(problem.edges), bool))
    with pytest.raises(GraphError, match="no matches"):
        adjust_epipolar(empty, R, p, np.zeros((0, 3)))
    with pytest.raises(GraphError, match="coincide"):
        adjust_epipolar(problem, R, np.zeros_like(p), directions_of(problem, R, p))


def line_of_cameras(*, sigma_px):
    """Six cameras on a line that look sideways: epipolar errors know every direction and no ratio of baselines."""
    place = np.array([0.0, 1.0, 1.7, 3.0, 4.1, 5.0])
    p = gauged(np.stack([place, np.zeros(6), np.zeros(6)], axis=1))
    R = np.tile(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), (6, 1, 1))
    edges = np.array([[i, j] for i in range(6) for j in range(i + 1, 6)])
    empty = np.zeros((0, 3))
    bare = EpipolarProblem(
        6, edges, np.zeros(16, int), empty, empty, np.zeros(6, int), np.array([1000.0]), np.zeros(1, bool)
    )
    points = np.random.default_rng(0).uniform([-1.5, 4.0, -1.0], [1.5, 7.0, 1.0], (200, 3))
    bent = p + np.array([0.0, 0.15, -0.1, 0.1, -0.2, 0.0])[:, None] * [1.0, 0.0, 0.0]
    return with_triplets(bare, R, p, points, sigma_px=sigma_px), R, p, bent


def test_triplets_fix_the_ratios_of_baselines_on_a_line():
    problem, R, p, bent = line_of_cameras(sigma_px=0.3)
    directions = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1]
    found = adjust_epipolar(problem, R, bent, directions)
    without = adjust_epipolar(replace(problem, triplets=None), R, bent, directions)
    with_error, without_error = (align_positions(f.projection_centers, p)[0].max() for f in (found, without))
    # Depth 5, baselines of 0.5, 60 tracks at 0.3 px: a baseline's ratio is known to about 5 / 0.5 * 3e-4 / sqrt(60).
    assert with_error < 3e-3
    assert without_error > 0.05
    exact, *_, start = line_of_cameras(sigma_px=0.0)
    found = adjust_epipolar(exact, R, start, directions, tolerance=1e-12)
    assert align_positions(found.projection_centers, p)[0].max() < 1e-7


def test_triplets_of_coinciding_cameras_keep_everything_finite():
    problem, R, p, bent = line_of_cameras(sigma_px=0.3)
    bent[1] = bent[0]
    directions = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1]
    cost, gradient = cost_and_gradient(problem, Cameras(R, bent, Lenses(np.zeros(1))), 2.0)
    assert np.isfinite(cost)
    assert np.isfinite(gradient).all()
    # A direction over a distance of nothing would pull a million times harder than those of cameras apart.
    apart = bent.copy()
    apart[1, 0] += 0.2
    usual = cost_and_gradient(problem, Cameras(R, apart, Lenses(np.zeros(1))), 2.0)[1]
    assert np.abs(gradient).max() < 100.0 * np.abs(usual).max()
    assert np.isfinite(adjust_epipolar(problem, R, bent, directions).projection_centers).all()


def test_triplets_leave_with_their_edges():
    problem, *_ = line_of_cameras(sigma_px=0.0)
    dropped = np.zeros(15, bool)
    dropped[4] = True
    left = problem.without(dropped)
    used = problem.triplets.edges
    assert len(left.triplets.images) == int((used != 4).all(axis=1).sum()) < len(used)
    # Each triplet's two edges still join its images.
    a, b, c = left.triplets.images.T
    for column, other in ((0, a), (1, c)):
        joined = np.sort(left.edges[left.triplets.edges[:, column]], axis=1)
        np.testing.assert_array_equal(joined, np.sort(np.stack([other, b], axis=1), axis=1))
    assert problem.without(np.arange(15) > 0).triplets is None


def test_last_scale_follows_the_noise_of_the_matches(monkeypatch: pytest.MonkeyPatch):
    # A fifth of the matches a pixel or two off, all to one side: at a fixed pixel they bend what the others tell.
    problem, R, p = scene(13, num_images=10, num_matches=60, sigma_px=0.1)
    rng = np.random.default_rng(0)
    wrong = rng.random(len(problem.bearings2)) < 0.2
    shift = np.where(wrong, rng.uniform(1.0, 2.0, len(wrong)), 0.0) / 1000.0
    off = normalized(problem.bearings2 + shift[:, None] * [0.6, 0.8, 0.0])
    problem = replace(problem, bearings2=off)
    start, directions = disturbed(R, p, 13, 0.02), directions_of(problem, R, p)
    followed = adjust_epipolar(problem, *start, directions)
    monkeypatch.setattr(adjustment, "START_SIGMAS", np.inf)
    fixed = adjust_epipolar(problem, *start, directions, scales_px=(8.0, 2.0, 1.0), final_sigmas=0.0)
    assert (
        align_positions(followed.projection_centers, p)[0].mean()
        < 0.5 * align_positions(fixed.projection_centers, p)[0].mean()
    )


def test_focal_lengths_that_the_matches_do_not_tell_are_held():
    problem, R, p = scene(4, sigma_px=0.3, free=True)
    rng = np.random.default_rng(3)
    anywhere = np.ones_like(problem.bearings1)
    anywhere[:, :2] = 0.3 * rng.standard_normal((len(anywhere), 2))
    noise = normalized(anywhere)
    found = adjust_epipolar(replace(problem, bearings1=noise), R, p, directions_of(problem, R, p))
    assert found.lost_focals.all()
    np.testing.assert_array_equal(found.focal_scales, 1.0)
    assert not adjust_epipolar(problem, R, p, directions_of(problem, R, p)).lost_focals.any()
