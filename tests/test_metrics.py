"""Metrics against scipy, brute force and the definition, and their freedom from the gauge."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from colmap_vg import metrics
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3


def _poses(n, seed, rotation_sigma=0.05, position_sigma=0.1):
    """Estimated and true cam_from_world rotations and centres, in one gauge."""
    rng = np.random.default_rng(seed)
    T, q = so3.random(n, rng), rng.standard_normal((n, 3))
    R = so3.perturbed(T, rotation_sigma, rng)
    return R, q + position_sigma * rng.standard_normal((n, 3)), T, q


def _moved(R, p, seed, scale):
    """The same poses in another world frame: x -> scale S x + t."""
    rng = np.random.default_rng(seed)
    S, t = so3.random(1, rng)[0], rng.standard_normal(3)
    return R @ S.T, scale * p @ S.T + t


def _relative_by_loop(R, p, T, q):
    """Scipy's rotations, one ordered pair after the other."""
    errors = []
    for i in range(len(R)):
        for j in range(len(R)):
            if i == j:
                continue
            turn = Rotation.from_matrix(R[j] @ R[i].T).inv() * Rotation.from_matrix(T[j] @ T[i].T)
            a, b = R[j] @ (p[i] - p[j]), T[j] @ (q[i] - q[j])
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
            errors.append(max(turn.magnitude(), np.arccos(np.clip(cosine, -1, 1))))
    return np.degrees(errors)


def test_positions_errors_by_a_generic_minimiser():
    _, p, _, q = _poses(12, 0)
    _, moved = _moved(np.tile(np.eye(3), (12, 1, 1)), p, 5, 3.0)
    result = metrics.position_errors(moved, q)

    def cost(x):
        return np.mean(np.sum((np.exp(x[6]) * Rotation.from_rotvec(x[:3]).apply(moved) + x[3:6] - q) ** 2, axis=1))

    s = result.similarity
    start = np.concatenate([Rotation.from_matrix(s.rotation).as_rotvec(), s.translation, [np.log(s.scale)]]) + 0.05
    assert result.rms == pytest.approx(np.sqrt(minimize(cost, start, tol=1e-12).fun), rel=1e-6)
    distances = np.linalg.norm(s.apply(moved) - q, axis=1)
    assert np.allclose(result.distances, distances, rtol=1e-12)
    assert result.mean == pytest.approx(distances.mean())
    assert result.median == pytest.approx(np.median(distances))
    assert result.rms == pytest.approx(np.sqrt(np.mean(distances**2)))


def test_rotation_errors_by_a_generic_minimiser():
    R, p, T, _ = _poses(12, 1, rotation_sigma=0.3)
    R, _ = _moved(R, p, 6, 1.0)
    result = metrics.rotation_errors(R, T)

    def cost(w):
        return np.sum((R @ Rotation.from_rotvec(w).as_matrix() - T) ** 2)

    best = Rotation.from_matrix(result.world_rotation).as_rotvec()
    found = minimize(cost, best + 0.1, tol=1e-12)
    assert cost(best) == pytest.approx(found.fun, rel=1e-9)
    angles = (
        Rotation.from_matrix(R) * Rotation.from_matrix(result.world_rotation) * Rotation.from_matrix(T).inv()
    ).magnitude()
    assert np.allclose(result.angles_deg, np.degrees(angles), atol=1e-9)
    assert result.median_deg == pytest.approx(np.median(result.angles_deg))
    assert result.mean_deg == pytest.approx(result.angles_deg.mean())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_no_metric_sees_the_gauge(first, second, scale):
    R, p, T, q = _poses(8, 3)
    Rm, pm = _moved(R, p, first, scale)
    Tm, qm = _moved(T, q, second, 1.0)
    a, b = metrics.position_errors(p, q), metrics.position_errors(pm, qm)
    assert np.abs(a.distances - b.distances).max() < 1e-9
    a, b = metrics.rotation_errors(R, T), metrics.rotation_errors(Rm, Tm)
    assert np.abs(a.angles_deg - b.angles_deg).max() < 1e-9
    relative = metrics.relative_pose_errors(R, p, T, q)
    moved = metrics.relative_pose_errors(Rm, pm, Tm, qm)
    assert np.abs(relative - moved).max() < 1e-7
    assert np.abs(metrics.area_under_curve(relative) - metrics.area_under_curve(moved)).max() < 1e-8


def test_exact_poses_have_no_error():
    R, p, T, q = _poses(9, 2, 0.0, 0.0)
    Rm, pm = _moved(R, p, 1, 7.0)
    assert metrics.position_errors(pm, q).rms < 1e-12
    assert metrics.rotation_errors(Rm, T).rms_deg < 1e-12
    relative = metrics.relative_pose_errors(Rm, pm, T, q)
    assert relative.max() < 1e-10
    assert np.abs(metrics.area_under_curve(relative) - 1.0).max() < 1e-9


def test_relative_pose_errors_pair_by_pair(monkeypatch):
    R, p, T, q = _poses(7, 4)
    expected = _relative_by_loop(R, p, T, q)
    assert np.abs(metrics.relative_pose_errors(R, p, T, q) - expected).max() < 1e-6
    monkeypatch.setattr(metrics, "PAIRS_AT_ONCE", 5)
    assert np.abs(metrics.relative_pose_errors(R, p, T, q) - expected).max() < 1e-6


def test_pairs_of_unregistered_images_fail():
    R, p, T, q = _poses(6, 5)
    all_errors = metrics.relative_pose_errors(R, p, T, q)
    R, p = R.copy(), p.copy()
    R[2], p[2] = np.nan, np.nan
    errors = metrics.relative_pose_errors(R, p, T, q)
    pairs = np.array([(i, j) for i in range(6) for j in range(6) if i != j])
    failed = (pairs == 2).any(axis=1)
    assert (errors[failed] == 180.0).all()
    assert np.array_equal(errors[~failed], all_errors[~failed])
    flags = np.array([True, True, False, True, True, True])
    assert np.array_equal(metrics.relative_pose_errors(R, p, T, q, registered=flags), errors)


def test_short_baselines_count_by_rotation_alone_and_merged_cameras_half_way():
    R, p, T, q = _poses(3, 6, 0.01, 0.0)
    p, q = p.copy(), q.copy()
    q[1] = q[0] + [1e-6, 0.0, 0.0]
    p[1] = p[0]
    first = metrics.relative_pose_errors(R, p, T, q)[0]
    assert first == pytest.approx(90.0)
    turn = np.degrees(so3.angle(R[1] @ R[0].T @ T[0] @ T[1].T))
    assert metrics.relative_pose_errors(R, p, T, q, min_baseline=1e-3)[0] == pytest.approx(turn, abs=1e-9)


def _recall_curve(errors, x):
    """Linear between the sorted errors, flat after the last one below the threshold."""
    e = np.concatenate([[0.0], np.sort(errors)])
    return np.interp(x, e, np.arange(len(e)) / len(errors))


@pytest.mark.parametrize("threshold", [0.5, 1.0, 5.0, 10.0])
def test_area_by_quadrature(threshold):
    errors = np.random.default_rng(0).exponential(3.0, 40)
    below = np.sort(errors[errors <= threshold])
    last = below[-1] if len(below) else 0.0
    area = quad(lambda x: _recall_curve(errors, x), 0.0, last, points=below, limit=200)[0]
    area += (threshold - last) * len(below) / len(errors)
    assert metrics.area_under_curve(errors, [threshold])[0] == pytest.approx(area / threshold, rel=1e-6)


def test_area_of_known_curves():
    assert metrics.area_under_curve(np.zeros(4)).tolist() == [1.0] * 4
    assert metrics.area_under_curve(np.array([20.0, np.inf])).tolist() == [0.0] * 4
    # Recall 1/2 from the error at 1 on: half of the first unit's triangle, then a rectangle.
    assert metrics.area_under_curve(np.array([1.0, 50.0]), [2.0])[0] == pytest.approx((0.25 + 0.5) / 2.0)


@pytest.mark.parametrize("errors", [[], [np.nan], [-1.0]])
def test_areas_of_nothing_are_refused(errors):
    with pytest.raises(GraphError, match="area_under_curve"):
        metrics.area_under_curve(np.array(errors))


def test_poses_that_do_not_fit_are_refused():
    R, p, T, q = _poses(4, 0)
    with pytest.raises(GraphError, match="rotation_errors"):
        metrics.rotation_errors(R[:3], T)
    with pytest.raises(GraphError, match="NaN"):
        metrics.rotation_errors(np.full((4, 3, 3), np.nan), T)
    with pytest.raises(GraphError, match="two images"):
        metrics.relative_pose_errors(R[:1], p[:1], T[:1], q[:1])
    with pytest.raises(GraphError, match="NaN"):
        metrics.relative_pose_errors(R, p, T, np.full((4, 3), np.nan))
