"""Epipolar adjustment: derivatives, exact recovery, focal lengths, gauge, reversed edges, an independent optimum."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from colmap_vg.epipolar.adjustment import Cameras, adjust_epipolar, cost_of, linearized
from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.epipolar.tracks import spread_tracks, triangulated
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.synthetic import nearest_neighbor_edges, ring_cameras


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
    p -= p.mean(axis=0)
    return problem, R, p / np.sqrt(np.mean(np.sum(p**2, axis=1)))


def cameras_at(R, p, log_scales=(0.0, 0.0), points=None):
    return Cameras(R, p, np.array(log_scales), np.zeros((0, 3)) if points is None else points)


def directions_of(problem, R, p):
    return cameras_at(R, p).relative(problem.edges)[1]


def shared_points(problem, R, p, seed, *, num_points=60, sigma_px=0.0):
    """The same cameras with points that all images see, as a problem and its tracks."""
    rng = np.random.default_rng(seed)
    n, edges = len(R), problem.edges
    local = np.einsum("nab,nkb->nka", R, rng.uniform(-0.4, 0.4, (num_points, 3))[None] - p[:, None])
    plane = local / local[..., 2:]
    plane[..., :2] += sigma_px / problem.focal_lengths[0] * rng.standard_normal((n, num_points, 2))
    rays = normalized(plane)
    keypoints = np.tile(np.arange(num_points, dtype=np.int32), len(edges))
    problem = replace(
        problem,
        offsets=num_points * np.arange(len(edges) + 1),
        bearings1=rays[edges[:, 0]].reshape(-1, 3),
        bearings2=rays[edges[:, 1]].reshape(-1, 3),
    )
    tracks = spread_tracks(n, edges, problem.offsets, keypoints, keypoints, problem.bearings1, problem.bearings2)
    return problem, tracks


def disturbed(R, p, seed, amount):
    rng = np.random.default_rng(seed)
    return so3.exp(amount * rng.standard_normal((len(R), 3))) @ R, p + amount * rng.standard_normal(p.shape)


@pytest.mark.parametrize("with_tracks", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_gradient_is_that_of_finite_differences(free, with_tracks):
    problem, R, p = scene(1, sigma_px=1.0, free=free)
    tracks, points = None, None
    if with_tracks:
        problem, tracks = shared_points(problem, R, p, seed=1)
        points = triangulated(tracks, R, p)
    R, p = disturbed(R, p, 2, 0.02)
    at = cameras_at(R, p, (0.05, -0.03) if free else (0.0, 0.0), points)
    size = 6 * len(R) + (2 if free else 0)
    found = linearized(problem, at, 3.0, tracks)
    assert found.cost == pytest.approx(cost_of(problem, at, 3.0, tracks), rel=1e-12)
    assert found.gradient.shape == (size,)
    free_rows = np.flatnonzero(problem.free_focals)
    rng = np.random.default_rng(0)
    for direction in (*np.eye(size)[:: 5 if free else 7], *np.eye(size)[-2:], *rng.standard_normal((3, size))):
        step = 1e-6 * direction / np.linalg.norm(direction)
        ahead, behind = (cost_of(problem, at.moved(sign * step, free_rows), 3.0, tracks) for sign in (1, -1))
        assert (ahead - behind) / 4.0 == pytest.approx(
            found.gradient @ step, rel=1e-4, abs=1e-11 * np.abs(found.gradient).max()
        )
    if tracks is not None and found.tracks is not None:
        step = 1e-6 * rng.standard_normal(points.shape)
        still = np.zeros(size)
        ahead, behind = (cost_of(problem, at.moved(still, free_rows, sign * step), 3.0, tracks) for sign in (1, -1))
        assert (ahead - behind) / 4.0 == pytest.approx(found.tracks.point_gradient @ step.ravel(), rel=1e-4)


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
    one = adjust_epipolar(problem, R0, p0, directions)
    two = adjust_epipolar(problem, R0 @ turn.T, 5.0 * p0 @ turn.T + 3.0, directions)
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
    found = adjust_epipolar(problem, *start, directions_of(problem, R, p), scales_px=(1.0,), tolerance=1e-13)
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
    with pytest.raises(GraphError, match="one place"):
        adjust_epipolar(problem, R, np.zeros_like(p), directions_of(problem, R, p))


def test_tracks_fix_what_a_line_of_cameras_leaves_open():
    # Six cameras on a line, looking sideways: epipolar errors know every direction and no ratio of baselines.
    place = np.array([0.0, 1.0, 1.7, 3.0, 4.1, 5.0])
    p = np.stack([place, np.zeros(6), np.zeros(6)], axis=1)
    p = (p - p.mean(axis=0)) / 1.8
    R = np.tile(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), (6, 1, 1))
    edges = np.array([[i, j] for i in range(6) for j in range(i + 1, 6)])
    points = np.random.default_rng(0).uniform([-1.5, 4.0, -1.0], [1.5, 7.0, 1.0], (200, 3))
    local = np.einsum("nab,nkb->nka", R, points[None] - p[:, None])
    rng = np.random.default_rng(1)
    local = local / local[..., 2:]
    local[..., :2] += 3e-4 * rng.standard_normal((6, 200, 2))
    rays = normalized(local)
    keypoints = np.tile(np.arange(200, dtype=np.int32), len(edges))
    problem = EpipolarProblem(
        6,
        edges,
        200 * np.arange(len(edges) + 1),
        rays[edges[:, 0]].reshape(-1, 3),
        rays[edges[:, 1]].reshape(-1, 3),
        np.zeros(6, dtype=int),
        np.array([1000.0]),
        np.array([False]),
    )
    bent = p + np.array([[0.0, 0, 0], [0.15, 0, 0], [-0.1, 0, 0], [0.1, 0, 0], [-0.2, 0, 0], [0.0, 0, 0]])
    directions = Cameras(R, p, np.zeros(1), np.zeros((0, 3))).relative(edges)[1]
    tracks = spread_tracks(6, edges, problem.offsets, keypoints, keypoints, problem.bearings1, problem.bearings2)
    without = adjust_epipolar(problem, R, bent, directions)
    found = adjust_epipolar(problem, R, bent, directions, tracks=tracks)
    with_error, without_error = (align_positions(f.projection_centers, p)[0].max() for f in (found, without))
    assert with_error < 0.3 * without_error
