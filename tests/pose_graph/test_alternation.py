"""Alg. 2C and 2O: the paper's turn, its fixed point by two roads, and what weights and information do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg import align_positions
from colmap_vg.geometry import so3
from colmap_vg.metrics import rotation_errors
from colmap_vg.pose_graph.alternation import solve_joint
from colmap_vg.pose_graph.gauss_newton import PoseGraphSolver, solve_pose_graph
from colmap_vg.positions.cls import solve_cls
from colmap_vg.rotations.chordal import average_rotations_chordal
from colmap_vg.simulation.ring_scenes import ring_scene

APPROACHES = ["C", "O"]


def _started(num_images, num_neighbors=5, **noise):
    """Scene, and the arguments of solve_joint up to the start: RS and CLS."""
    scene = ring_scene(num_images, num_neighbors, **noise)
    graph = scene.graph
    R = average_rotations_chordal(num_images, graph.edges, graph.cam2_from_cam1_rotations).cam_from_world_rotations
    directions = np.einsum("kba,kb->ka", R[graph.edges[:, 0]], graph.cam2_in_cam1_directions)
    p = solve_cls(num_images, graph.edges, directions).projection_centers
    return scene, (num_images, graph.edges, graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_directions, R, p)


def _relative_to_first(R):
    return R @ R[0].T


def _paper_turn(arguments, R, p, approach):
    """One turn of Alg. 2: lambda, w, PS; then the gauge."""
    n, edges, relative, directions = arguments[:4]
    length = np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1)
    tau = np.ones(len(edges)) if approach == "C" else 1.0 / length**2
    result = solve_pose_graph(n, edges, relative, length[:, None] * directions, R, p, None, tau)
    new = result.projection_centers - result.projection_centers.mean(axis=0)
    return result.cam_from_world_rotations, new * (np.linalg.norm(p) / np.linalg.norm(new))


@pytest.mark.parametrize("approach", APPROACHES)
def test_turns_are_the_paper_s(approach):
    _, arguments = _started(25, rotation_sigma=0.03, direction_sigma=0.1, seed=1)
    R, p = arguments[4:]
    for count in (1, 3):
        result = solve_joint(*arguments, approach, accelerate=False, max_num_iterations=count, tolerance=0.0)
        expected_R, expected_p = R, p
        for _ in range(count):
            expected_R, expected_p = _paper_turn(arguments, expected_R, expected_p, approach)
        errors, similarity = align_positions(result.projection_centers, expected_p)
        assert errors.max() < 1e-5 * np.abs(p).max()  # the first inner problems are solved to 1e-6
        assert similarity.scale == pytest.approx(1.0, abs=1e-9)
        assert np.abs(_relative_to_first(result.cam_from_world_rotations) - _relative_to_first(expected_R)).max() < 1e-5


@pytest.mark.parametrize("approach", APPROACHES)
@pytest.mark.parametrize("seed", range(2))
def test_plain_and_accelerated_forms_reach_the_same_fixed_point(approach, seed):
    _, arguments = _started(20, 6, rotation_sigma=0.02, direction_sigma=0.05, seed=seed)
    fast = solve_joint(*arguments, approach, tolerance=1e-11)
    plain = solve_joint(*arguments, approach, accelerate=False, tolerance=1e-12, max_num_iterations=5000)
    assert fast.converged
    assert plain.converged
    size = np.linalg.norm(arguments[5])
    assert np.linalg.norm(fast.projection_centers - plain.projection_centers) < 1e-8 * size
    between = fast.cam_from_world_rotations @ np.swapaxes(plain.cam_from_world_rotations, 1, 2)
    assert so3.angle(between).max() < 1e-8
    assert fast.num_iterations < plain.num_iterations / 3
    R, p = _paper_turn(arguments, fast.cam_from_world_rotations, fast.projection_centers, approach)
    assert np.linalg.norm(p - fast.projection_centers) < 1e-8 * size
    assert so3.angle(R @ np.swapaxes(fast.cam_from_world_rotations, 1, 2)).max() < 1e-8
    assert np.linalg.norm(fast.projection_centers) == pytest.approx(size, rel=1e-12)


@pytest.mark.parametrize("approach", APPROACHES)
def test_noise_free_graphs_are_recovered_from_a_bad_start(approach):
    scene, arguments = _started(30, 6, seed=2)
    rng = np.random.default_rng(0)
    R = so3.perturbed(arguments[4], 0.1, rng)
    p = scene.projection_centers + 0.2 * rng.standard_normal(scene.projection_centers.shape)
    result = solve_joint(*arguments[:4], R, p, approach, tolerance=1e-12)
    assert result.converged
    errors, _ = align_positions(result.projection_centers, scene.projection_centers)
    assert errors.max() < 1e-8 * 4.0
    turn = np.swapaxes(result.cam_from_world_rotations, 1, 2) @ scene.cam_from_world_rotations
    assert so3.angle(turn @ turn[0].T).max() < 1e-8


def test_the_scale_weighs_the_terms_of_2c_and_not_those_of_2o():
    _, arguments = _started(20, rotation_sigma=0.03, direction_sigma=0.05, seed=1)
    larger = (*arguments[:5], 10.0 * arguments[5])
    for approach, differs in (("C", True), ("O", False)):
        a = solve_joint(*arguments, approach, tolerance=1e-12)
        b = solve_joint(*larger, approach, tolerance=1e-12)
        turn = so3.angle(a.cam_from_world_rotations @ np.swapaxes(b.cam_from_world_rotations, 1, 2)).max()
        assert (turn > 1e-4) == differs
        assert differs or turn < 1e-8


def test_isotropic_information_gives_the_paper_s_2o_for_small_noise():
    _, arguments = _started(20, rotation_sigma=1e-3, direction_sigma=1e-3, seed=1)
    information = np.tile(np.diag([2.0, 2.0, 2.0, 1.0, 1.0]), (len(arguments[1]), 1, 1))
    a = solve_joint(*arguments, "O", tolerance=1e-11)
    b = solve_joint(*arguments, "O", information=information, tolerance=1e-11)
    assert b.converged
    assert np.abs(a.projection_centers - b.projection_centers).max() < 1e-4 * np.abs(a.projection_centers).max()


def test_weighing_edges_by_their_information_halves_the_error():
    n, rng = 40, np.random.default_rng(0)
    scene, arguments = _started(n, 8, rotation_sigma=0.0, direction_sigma=0.0, seed=3)
    _, edges, relative, directions, R, p = arguments
    sigma_R, sigma_d = 10.0 ** rng.uniform(-3.5, -1.5, (2, len(edges)))
    relative = so3.exp(sigma_R[:, None] * rng.standard_normal((len(edges), 3))) @ relative
    turned = so3.exp(sigma_d[:, None] * rng.standard_normal((len(edges), 3)))
    directions = np.einsum("kab,kb->ka", turned, directions)
    information = np.zeros((len(edges), 5, 5))
    information[:, range(3), range(3)] = sigma_R[:, None] ** -2
    information[:, range(3, 5), range(3, 5)] = sigma_d[:, None] ** -2
    errors = []
    for known in (None, information):
        result = solve_joint(n, edges, relative, directions, R, p, "O", information=known)
        assert result.converged
        errors.append(np.mean(align_positions(result.projection_centers, scene.projection_centers)[0]))
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_the_weighted_form_forgets_false_edges_and_rotations_gain():
    n, rng = 40, np.random.default_rng(1)
    scene, (_, edges, relative, directions, _R, p) = _started(n, 10, rotation_sigma=0.0, direction_sigma=0.0, seed=3)
    sigma = 10.0 ** rng.uniform(-3.0, -1.5, len(edges))
    relative = so3.exp(sigma[:, None] * rng.standard_normal((len(edges), 3))) @ relative
    directions = np.einsum("kab,kb->ka", so3.exp(sigma[:, None] * rng.standard_normal((len(edges), 3))), directions)
    false = rng.random(len(edges)) < 0.1
    relative[false] = so3.exp(0.3 * rng.standard_normal((false.sum(), 3))) @ relative[false]
    directions[false] = np.einsum("kab,kb->ka", so3.random(false.sum(), rng), directions[false])
    # Stated three times too sure, all alike: the loss's scale makes up for it.
    information = np.eye(5) * (3.0 / sigma[:, None, None]) ** 2
    rough = average_rotations_chordal(n, edges, relative).cam_from_world_rotations
    positions, rotations = [], []
    for kwargs in ({}, {"information": information}, {"information": information, "robust": True}):
        result = solve_joint(n, edges, relative, directions, rough, p, "O", **kwargs)
        positions.append(np.median(align_positions(result.projection_centers, scene.projection_centers)[0]))
        rotations.append(rotation_errors(result.cam_from_world_rotations, scene.cam_from_world_rotations).median_deg)
    assert positions[2] < 0.5 * positions[1]
    assert positions[2] < 0.1 * positions[0]
    assert rotations[2] < 0.5 * rotation_errors(rough, scene.cam_from_world_rotations).median_deg
    assert result.log[0].stage == "2W"


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(APPROACHES))
def test_the_choice_of_world_and_the_order_do_not_matter(seed, approach):
    rng = np.random.default_rng(seed)
    _, (n, edges, relative, directions, R, p) = _started(12, rotation_sigma=0.02, direction_sigma=0.05, seed=4)
    turn, images, order = so3.random(1, rng)[0], rng.permutation(n), rng.permutation(len(edges))
    row = np.argsort(images)
    a = solve_joint(n, edges, relative, directions, R, p, approach, tolerance=1e-11)
    b = solve_joint(
        n,
        row[edges[order]],
        relative[order],
        directions[order],
        (R @ turn.T)[images],
        (p @ turn.T)[images] + rng.standard_normal(3),
        approach,
        tolerance=1e-11,
    )
    errors, _ = align_positions(b.projection_centers[row], a.projection_centers)
    assert errors.max() < 1e-7 * np.abs(a.projection_centers).max()
    between = _relative_to_first(a.cam_from_world_rotations) - _relative_to_first(b.cam_from_world_rotations[row])
    assert np.abs(between).max() < 1e-7


def test_inner_problems_near_the_fixed_point_take_no_newton_steps(monkeypatch):
    _, arguments = _started(25, rotation_sigma=0.03, direction_sigma=0.1, seed=1)
    solved = []
    newton = PoseGraphSolver.solve
    monkeypatch.setattr(PoseGraphSolver, "solve", lambda *a, **k: solved.append(1) or newton(*a, **k))
    result = solve_joint(*arguments, "C", tolerance=1e-9)
    assert result.converged
    assert 1 <= len(solved) < result.num_iterations / 3
