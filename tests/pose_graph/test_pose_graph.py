"""PS: derivatives against finite differences, minima against scipy, gtsam and a noise-free truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from colmap_vg import align_positions
from colmap_vg.datasets.g2o import read_g2o
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.pose_graph.costs import ChordalCost, InformationCost
from colmap_vg.pose_graph.gauss_newton import PoseGraphSolver, solve_pose_graph
from colmap_vg.rotations.chordal import average_rotations_chordal
from colmap_vg.simulation.ring_scenes import nearest_neighbor_edges, ring_cameras


def _random_information(num_edges, rng):
    root = rng.standard_normal((num_edges, 6, 6))
    return root @ np.swapaxes(root, 1, 2) + 0.5 * np.eye(6)


def _pose_graph(num_images, *, rotation_sigma=0.0, translation_sigma=0.0, seed=0, num_neighbors=5):
    """True rotations (cam_from_world) and centres, edges, and noisy relative poses."""
    rng = np.random.default_rng(seed)
    R, p = ring_cameras(num_images, rng)
    edges = nearest_neighbor_edges(p, num_neighbors)
    i, j = edges.T
    relative = so3.perturbed(R[j] @ np.swapaxes(R[i], 1, 2), rotation_sigma, rng)
    translations = np.einsum("kab,kb->ka", R[i], p[j] - p[i])
    return R, p, edges, relative, translations + translation_sigma * rng.standard_normal(translations.shape)


def _perturbed_start(R, p, sigma, seed=0):
    rng = np.random.default_rng(seed)
    return so3.perturbed(R, sigma, rng), p + sigma * rng.standard_normal(p.shape)


def _costs(edges, relative, translations, seed=0):
    rng = np.random.default_rng(seed)
    kappa, tau = rng.uniform(0.3, 2.0, (2, len(edges)))
    return {
        "chordal": ChordalCost(edges, relative, translations, kappa, tau),
        "information": InformationCost(edges, relative, translations, _random_information(len(edges), rng)),
    }


@pytest.mark.parametrize("kind", ["chordal", "information"])
def test_gradient_by_finite_differences(kind):
    R, p, edges, relative, translations = _pose_graph(8, rotation_sigma=0.3, translation_sigma=0.3)
    cost = _costs(edges, relative, translations)[kind]
    R, p = _perturbed_start(R, p, 0.3)
    Q = np.swapaxes(R, 1, 2)
    gradient = PoseGraphSolver(len(p), edges).gradient(cost, Q, p)
    step, expected = 1e-5, np.zeros((len(p), 6))
    for camera in range(len(p)):
        for axis in range(6):
            values = []
            for sign in (1.0, -1.0):
                delta = np.zeros((len(p), 6))
                delta[camera, axis] = sign * step
                values.append(cost.value(so3.exp(delta[:, :3]) @ Q, p + delta[:, 3:]))
            expected[camera, axis] = (values[0] - values[1]) / (2.0 * step)
    assert np.abs(gradient - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize("outlier", [False, True])
def test_curvature_completes_the_exact_hessian(outlier):
    R, p, edges, relative, translations = _pose_graph(5, rotation_sigma=0.2, translation_sigma=0.5, num_neighbors=3)
    if outlier:
        relative[1] = so3.exp(np.array([[0.5, 2.0, -1.0]]))[0] @ relative[1]  # there the chordal term is not convex
    cost = _costs(edges, relative, translations)["chordal"]
    Q, n = np.swapaxes(R, 1, 2), len(p)
    solver, terms = PoseGraphSolver(n, edges), cost.derivatives(Q, p)
    H = np.zeros((n, 6, n, 6))
    for k, (i, j) in enumerate(edges):
        ii, ij = terms.ii[k].copy(), terms.ij[k].copy()
        ii[:3, :3] += terms.curvature_ii[k]
        ij[:3, :3] += terms.curvature_ij[k]
        jj = terms.jj[k].copy()
        jj[:3, :3] += terms.curvature_jj[k]
        H[i, :, i] += ii
        H[j, :, j] += jj
        H[i, :, j] += ij
        H[j, :, i] += ij.T
    H = H.reshape(6 * n, 6 * n)
    step, rng = 1e-4, np.random.default_rng(0)
    for _ in range(5):  # along a line through exp, second differences of the cost are v^T H v
        v = rng.standard_normal((n, 6))
        values = [cost.value(so3.exp(t * v[:, :3]) @ Q, p + t * v[:, 3:]) for t in (-step, 0.0, step)]
        second = (values[0] - 2.0 * values[1] + values[2]) / step**2
        assert v.ravel() @ H @ v.ravel() == pytest.approx(second, rel=1e-6)
    assert solver.num_images == n


@pytest.mark.parametrize("full_information", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_minimum_of_a_generic_solver(full_information, seed):
    R, p, edges, relative, translations = _pose_graph(6, rotation_sigma=0.1, translation_sigma=0.2, seed=seed)
    rng = np.random.default_rng(seed)
    kappa, tau = rng.uniform(0.3, 2.0, (2, len(edges)))
    information = _random_information(len(edges), rng) if full_information else None
    result = solve_pose_graph(6, edges, relative, translations, R, p, kappa, tau, information=information)

    def residuals(x):
        turned = so3.exp(x.reshape(-1, 6)[:, :3]) @ np.swapaxes(R[1:], 1, 2)
        Q, c = (
            np.concatenate([R[:1].transpose(0, 2, 1), turned]),
            np.concatenate([p[:1], p[1:] + x.reshape(-1, 6)[:, 3:]]),
        )
        rows = []
        for k, (i, j) in enumerate(edges):
            if full_information:
                e = [so3.log(Q[j].T @ Q[i] @ relative[k].T), Q[i].T @ (c[j] - c[i]) - translations[k]]
                scaled = np.concatenate([np.sqrt(kappa[k]) * e[0], np.sqrt(tau[k]) * e[1]])
                rows.append(np.linalg.cholesky(information[k]).T @ scaled)
            else:
                rows.append(np.sqrt(kappa[k]) * (relative[k] - Q[j].T @ Q[i]).ravel())
                rows.append(np.sqrt(tau[k]) * (Q[i] @ translations[k] - (c[j] - c[i])))
        return np.concatenate(rows)

    reference = least_squares(residuals, np.zeros(30), xtol=1e-15, ftol=1e-15, gtol=1e-13)
    assert result.converged
    assert result.gradient < 1e-9
    assert result.cost == pytest.approx(2.0 * reference.cost, rel=1e-9)
    assert np.sum(residuals(np.zeros(30)) ** 2) > 1.01 * result.cost


@pytest.mark.parametrize("full_information", [False, True])
def test_noise_free_poses_are_recovered(full_information):
    R, p, edges, relative, translations = _pose_graph(60)
    information = _random_information(len(edges), np.random.default_rng(0)) if full_information else None
    result = solve_pose_graph(60, edges, relative, translations, *_perturbed_start(R, p, 0.2), information=information)
    errors, _ = align_positions(result.projection_centers, p)
    turn = np.swapaxes(result.cam_from_world_rotations, 1, 2) @ R
    assert errors.max() < 1e-8
    assert so3.angle(turn @ turn[0].T).max() < 1e-8


def test_cost_never_rises_and_the_end_is_quadratic():
    R, p, edges, relative, translations = _pose_graph(80, rotation_sigma=0.1, translation_sigma=0.3, seed=3)
    log = solve_pose_graph(80, edges, relative, translations, *_perturbed_start(R, p, 0.3)).log
    costs = np.array([entry.cost for entry in log])
    assert (np.diff(costs) <= 1e-12 * costs[0]).all()
    assert len(log) < 15


@pytest.mark.parametrize("kind", ["chordal", "information"])
def test_an_old_factorisation_reaches_the_minimum_of_a_similar_problem(kind):
    R, p, edges, relative, translations = _pose_graph(20, rotation_sigma=0.05, translation_sigma=0.05)
    solver, Q = PoseGraphSolver(20, edges), np.swapaxes(R, 1, 2)
    Q, p, _ = solver.solve(_costs(edges, relative, translations)[kind], Q, p)
    similar = _costs(edges, relative, 1.02 * translations)[kind]
    near_Q, near_p = solver.solve_nearby(similar, Q, p, 1.0, 1e-11)
    exact_Q, exact_p, _ = PoseGraphSolver(20, edges).solve(similar, Q, p)
    assert np.abs(near_p - p).max() > 1e-2
    assert align_positions(near_p, exact_p)[0].max() < 1e-8
    turn = exact_Q[0] @ near_Q[0].T
    assert so3.angle(np.swapaxes(exact_Q, 1, 2) @ turn @ near_Q).max() < 1e-8
    assert similar.value(near_Q, near_p) == pytest.approx(similar.value(exact_Q, exact_p), rel=1e-12)


def test_far_from_the_minimum_an_old_factorisation_gives_up():
    R, p, edges, relative, translations = _pose_graph(20, rotation_sigma=0.05, translation_sigma=0.05)
    R, p = _perturbed_start(R, p, 1.5)
    cost = _costs(edges, relative, translations)["chordal"]
    assert PoseGraphSolver(20, edges).solve_nearby(cost, np.swapaxes(R, 1, 2), p, 1.0, 1e-9) is None


@pytest.mark.parametrize("kind", ["chordal", "information"])
def test_the_best_scale_is_that_of_least_cost(kind):
    R, p, edges, relative, translations = _pose_graph(8, rotation_sigma=0.3, translation_sigma=0.3)
    cost, Q = _costs(edges, relative, translations)[kind], np.swapaxes(R, 1, 2)
    best = cost.best_scale(Q, 3.0 * p)
    assert best == pytest.approx(1 / 3, rel=0.2)
    assert cost.value(Q, 3.0 * best * p) < min(cost.value(Q, 3.0 * factor * best * p) for factor in (0.999, 1.001))


def test_isotropic_information_is_the_chordal_cost_for_small_angles():
    R, p, edges, relative, translations = _pose_graph(20, rotation_sigma=1e-3, translation_sigma=1e-3, seed=3)
    kappa, tau = 3.0, 2.0
    information = np.tile(np.diag([2.0 * kappa] * 3 + [tau] * 3), (len(edges), 1, 1))
    ones = np.ones(len(edges))
    a = solve_pose_graph(20, edges, relative, translations, R, p, kappa * ones, tau * ones)
    b = solve_pose_graph(20, edges, relative, translations, R, p, information=information)
    assert b.cost == pytest.approx(a.cost, rel=1e-5)
    assert np.abs(a.projection_centers - b.projection_centers).max() < 1e-5


def test_outliers_do_not_slow_the_end():
    R, p, edges, relative, translations = _pose_graph(60, rotation_sigma=0.05, translation_sigma=0.2, num_neighbors=12)
    wrong = np.arange(0, len(edges), 12)
    relative[wrong] = so3.random(len(wrong), np.random.default_rng(0))
    result = solve_pose_graph(60, edges, relative, translations, R, p)
    assert result.gradient < 1e-12
    assert result.num_iterations < 15  # Gauss-Newton on edges that are far off takes hundreds


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_choice_of_world_and_the_order_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    R, p, edges, relative, translations = _pose_graph(15, rotation_sigma=0.05, translation_sigma=0.1, seed=1)
    turn, shift = so3.random(1, rng)[0], 3.0 * rng.standard_normal(3)
    images, order = rng.permutation(15), rng.permutation(len(edges))
    a = solve_pose_graph(15, edges, relative, translations, R, p)
    b = solve_pose_graph(
        15,
        np.argsort(images)[edges[order]],
        relative[order],
        translations[order],
        (R @ turn.T)[images],
        (p @ turn.T + shift)[images],
    )
    assert b.cost == pytest.approx(a.cost, rel=1e-10)
    relative_to_first = [
        r.cam_from_world_rotations @ r.cam_from_world_rotations[k].T for r, k in ((a, 0), (b, np.argsort(images)[0]))
    ]
    assert np.abs(relative_to_first[0] - relative_to_first[1][np.argsort(images)]).max() < 1e-8


def test_information_of_another_shape_is_refused():
    R, p, edges, relative, translations = _pose_graph(6)
    with pytest.raises(GraphError, match="information"):
        solve_pose_graph(6, edges, relative, translations, R, p, information=np.zeros((3, 6, 6)))


def _noise_free_sphere(path):
    """Edges, relative rotations and translations of a file of ``EDGE3 i j x y z roll pitch yaw`` lines."""
    rows = np.array([line.split()[1:9] for line in path.read_text().splitlines() if line.startswith("EDGE3")], float)
    cam1_from_cam2 = Rotation.from_euler("ZYX", rows[:, [7, 6, 5]]).as_matrix()
    return rows[:, :2].astype(int), np.swapaxes(cam1_from_cam2, 1, 2), rows[:, 2:5]


@pytest.mark.real_data
def test_sphere2500_against_its_noise_free_truth(data_folder):
    folder = data_folder / "view_graphs" / "pose_graphs"
    edges, relative, translations = _noise_free_sphere(folder / "sphere2500_groundtruth.txt")
    n = edges.max() + 1
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for k in np.flatnonzero(edges[:, 1] == edges[:, 0] + 1):  # chained, in order
        i, j = edges[k]
        R[j], p[j] = relative[k] @ R[i], p[i] + R[i].T @ translations[k]
    graph = read_g2o(folder / "sphere2500.g2o")
    kappa, tau = graph.chordal_weights()
    measured = graph.edges, graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_translations
    noisy = average_rotations_chordal(n, measured[0], measured[1], kappa).cam_from_world_rotations
    result = solve_pose_graph(n, *measured, noisy, graph.projection_centers, kappa, tau)
    radius = np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))
    errors, _ = align_positions(result.projection_centers, p)
    assert np.median(errors) < 0.03 * radius
    exact = solve_pose_graph(n, edges, relative, translations, *_perturbed_start(R, p, 0.1))
    # The file holds six digits: its loops do not close better.
    assert align_positions(exact.projection_centers, p)[0].max() < 1e-3 * radius
    assert exact.cost < 1e-6


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["smallGrid3D", "parking-garage", "sphere2500", "torus3D"])
def test_minimum_of_gtsam(name, data_folder):
    gtsam = pytest.importorskip("gtsam")
    graph = read_g2o(data_folder / "view_graphs" / "pose_graphs" / f"{name}.g2o")
    kappa, tau = graph.chordal_weights()
    n = len(graph.ids)
    R = average_rotations_chordal(n, graph.edges, graph.cam2_from_cam1_rotations, kappa).cam_from_world_rotations
    result = solve_pose_graph(
        n,
        graph.edges,
        graph.cam2_from_cam1_rotations,
        graph.cam2_in_cam1_translations,
        R,
        graph.projection_centers,
        kappa,
        tau,
    )
    assert result.converged

    factors, start, ours = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
    for k, (i, j) in enumerate(graph.edges):
        measured = gtsam.Pose3(gtsam.Rot3(graph.cam2_from_cam1_rotations[k].T), graph.cam2_in_cam1_translations[k])
        precisions = np.ones((4, 4))  # of the entries of T_j - T_i T_ij; its last row is zero
        precisions[:3, :3], precisions[:3, 3] = kappa[k], tau[k]
        noise = gtsam.noiseModel.Diagonal.Precisions(precisions.ravel(order="F"))
        factors.add(gtsam.FrobeniusBetweenFactorPose3(int(i), int(j), measured, noise))
    for k in range(n):
        start.insert(k, gtsam.Pose3(gtsam.Rot3(R[k].T), graph.projection_centers[k]))
        ours.insert(k, gtsam.Pose3(gtsam.Rot3(result.cam_from_world_rotations[k].T), result.projection_centers[k]))
    assert 2.0 * factors.error(ours) == pytest.approx(result.cost, rel=1e-9)
    params = gtsam.GaussNewtonParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-14)
    costs = []
    for values, num_iterations in ((start, 60), (ours, 10)):  # on torus3D 60 iterations from the start end 5e-6 above
        params.setMaxIterations(num_iterations)
        anchored = gtsam.NonlinearFactorGraph()
        anchored.push_back(factors)
        anchored.addPriorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Precision(6, 1e3))
        costs.append(2.0 * factors.error(gtsam.GaussNewtonOptimizer(anchored, values, params).optimize()))
    assert result.cost == pytest.approx(min(costs), rel=1e-6)
    assert result.cost <= costs[0] * (1.0 + 1e-6)
