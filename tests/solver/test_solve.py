"""The whole chain on graphs whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg import (
    EdgeVerdict,
    ImageVerdict,
    SolutionStatus,
    SolveOptions,
    ViewGraph,
    align_positions,
    read_view_graph,
    solve_view_graph,
)
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.simulation.views import synthetic_views
from colmap_vg.solver import position_stage

PAPER = {"rotation_averaging": "chordal", "rotation_gate_deg": 0.0, "outlier_filter": "none"}
METHODS = ["1C", "1O", "2C", "2O"]


def _errors(solution, scene):
    r = solution.registered
    return align_positions(solution.projection_centers[r], scene.projection_centers[r])[0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("front", [{}, PAPER])
def test_noise_free_graphs_are_recovered(method, front):
    scene = ring_scene(25, 6, seed=3)
    solution = solve_view_graph(scene.graph, SolveOptions(method=method, convergence_tolerance=1e-12, **front))
    assert solution.status == SolutionStatus.SOLVED
    spread = np.sqrt(np.mean(np.sum((scene.projection_centers - scene.projection_centers.mean(0)) ** 2, axis=1)))
    assert _errors(solution, scene).max() / spread < 1e-8
    turn = np.swapaxes(solution.cam_from_world_rotations, 1, 2) @ scene.cam_from_world_rotations
    assert so3.angle(turn @ turn[0].T).max() < 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_outliers_leave_with_a_verdict_and_positions_stay_right(method):
    scene = ring_scene(100, 10, rotation_sigma=0.004, direction_sigma=0.02, outlier_share=0.25, seed=1)
    solution = solve_view_graph(scene.graph, SolveOptions(method=method))
    assert not (solution.edge_kept & scene.outlier).any()
    assert (~solution.edge_kept & ~scene.outlier).sum() <= 0.01 * (~scene.outlier).sum()
    dropped = {EdgeVerdict.ROTATION_OUTLIER, EdgeVerdict.DIRECTION_OUTLIER, EdgeVerdict.OUTSIDE}
    assert set(solution.edge_verdicts[~solution.edge_kept]) <= dropped
    assert _errors(solution, scene).max() < 0.1 * 4.0


def test_the_paper_s_own_front_removes_outliers_by_1dsfm():
    scene = ring_scene(100, 10, rotation_sigma=0.004, direction_sigma=0.02, seed=1)
    graph = scene.graph
    wrong = np.zeros(graph.num_edges, dtype=bool)
    wrong[::12] = True
    directions = graph.cam2_in_cam1_directions.copy()
    directions[wrong] *= -1.0
    graph = replace(graph, cam2_in_cam1_directions=directions)
    options = SolveOptions(method="1C", rotation_averaging="chordal", rotation_gate_deg=0.0, outlier_filter="1dsfm")
    solution = solve_view_graph(graph, options)
    dropped = solution.edge_verdicts == EdgeVerdict.ONE_DSFM
    assert dropped[wrong].mean() > 0.6
    assert dropped[~wrong].mean() < 0.1


def test_images_outside_are_left_out_with_their_reason():
    scene = ring_scene(20, 4)
    g = scene.graph
    n = g.num_images

    def edge_to(row):
        return np.array([[0, row]])

    # Image n hangs on one edge, n + 1 and n + 2 are a pair of their own, n + 3 has nothing.
    edges = np.concatenate([g.edges, edge_to(n), np.array([[n + 1, n + 2]])])
    graph = ViewGraph(
        np.arange(10, 10 + n + 4),
        edges,
        np.concatenate([g.cam2_from_cam1_rotations, np.tile(np.eye(3), (2, 1, 1))]),
        np.concatenate([g.cam2_in_cam1_directions, np.tile([0.0, 0.0, 1.0], (2, 1))]),
    )
    solution = solve_view_graph(graph, SolveOptions(method="1O"))
    assert solution.status == SolutionStatus.PARTIAL
    assert solution.image_verdicts[:n].tolist() == [ImageVerdict.REGISTERED] * n
    assert solution.image_verdicts[n:].tolist() == [
        ImageVerdict.NOT_RIGID,
        ImageVerdict.SMALLER_COMPONENT,
        ImageVerdict.SMALLER_COMPONENT,
        ImageVerdict.NO_EDGES,
    ]
    assert np.isnan(solution.projection_centers[n:]).all()
    assert solution.component.tolist() == [0] * n + [-1] * 4
    assert solution.edge_verdicts[-2:].tolist() == [EdgeVerdict.OUTSIDE] * 2
    assert "4 of 24" in solution.message


@pytest.mark.parametrize("edges", [[], [(0, 1)], [(0, 1), (2, 3)]])
def test_graphs_that_fix_nothing_are_unsolvable_and_say_so(edges):
    m = len(edges)
    graph = ViewGraph(
        np.arange(4),
        np.array(edges, dtype=int).reshape(m, 2),
        np.tile(np.eye(3), (m, 1, 1)),
        np.tile([0.0, 0.0, 1.0], (m, 1)),
    )
    solution = solve_view_graph(graph)
    assert solution.status == SolutionStatus.UNSOLVABLE
    assert not solution.registered.any()
    assert "overlapping" in solution.message


def test_parts_that_nothing_links_are_components_of_their_own():
    # Two rings that share an image hinge on it; a third one has one false link to the first.
    scenes = [ring_scene(12, 4, seed=1), ring_scene(8, 4, seed=2), ring_scene(6, 4, seed=3)]
    starts = np.cumsum([0, 11, 8])
    edges = np.concatenate([scene.graph.edges + start for scene, start in zip(scenes, starts, strict=True)])
    false_link = np.array([[3, starts[2] + 1]])
    graph = ViewGraph(
        np.arange(starts[2] + 6),
        np.concatenate([edges, false_link]),
        np.concatenate([*(s.graph.cam2_from_cam1_rotations for s in scenes), so3.exp(np.array([[2.0, 1.0, 0.5]]))]),
        np.concatenate([*(s.graph.cam2_in_cam1_directions for s in scenes), [[0.0, 0.0, 1.0]]]),
    )
    solution = solve_view_graph(graph, SolveOptions(method="1O"))
    assert solution.component.tolist() == [0] * 12 + [1] * 7 + [2] * 6
    assert solution.registered.tolist() == [True] * 12 + [False] * 13
    assert solution.image_verdicts.tolist() == [ImageVerdict.REGISTERED] * 12 + [ImageVerdict.OTHER_MODEL] * 13
    assert solution.status == SolutionStatus.PARTIAL
    assert not solution.edge_kept[-1]
    for index, (scene, start) in enumerate(zip(scenes, starts, strict=True)):
        rows = np.flatnonzero(solution.component == index)
        errors, _ = align_positions(solution.projection_centers[rows], scene.projection_centers[rows - start])
        assert errors.max() < 1e-6
        assert np.mean(np.sum(solution.projection_centers[rows] ** 2, axis=1)) == pytest.approx(1.0)


def test_images_whose_directions_hardly_fix_them_are_left_out():
    scene = ring_scene(40, 8, direction_sigma=0.01, rotation_sigma=0.002, seed=5)
    g, rng = scene.graph, np.random.default_rng(5)
    # One more image, far outside, is seen by two neighbours under nearly the same direction.
    center = scene.projection_centers.mean(axis=0) + 40 * (scene.projection_centers[0] - scene.projection_centers[1])
    R = np.concatenate([scene.cam_from_world_rotations, np.eye(3)[None]])
    p = np.concatenate([scene.projection_centers, center[None]])
    new = np.array([[0, 40], [1, 40]])
    directions = np.einsum("kab,kb->ka", R[new[:, 0]], p[40] - p[new[:, 0]])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) + 0.01 * rng.standard_normal((2, 3))
    graph = ViewGraph(
        np.arange(41),
        np.concatenate([g.edges, new]),
        np.concatenate([g.cam2_from_cam1_rotations, np.swapaxes(R[new[:, 0]], 1, 2)]),
        np.concatenate([g.cam2_in_cam1_directions, directions / np.linalg.norm(directions, axis=1, keepdims=True)]),
    )
    solution = solve_view_graph(graph)
    assert solution.image_verdicts[40] == ImageVerdict.UNCERTAIN
    assert solution.registered[:40].all()
    assert align_positions(solution.projection_centers[:40], scene.projection_centers)[0].max() < 0.05


def test_edges_refused_on_reading_are_not_used():
    scene = ring_scene(20, 6)
    words = np.full(scene.graph.num_edges, EdgeVerdict.KEPT, dtype=object)
    words[::5] = EdgeVerdict.WATERMARK
    directions = scene.graph.cam2_in_cam1_directions.copy()
    directions[::5] = [0.0, 0.0, 1.0]
    graph = replace(scene.graph, read_verdicts=words.astype(str), cam2_in_cam1_directions=directions)
    solution = solve_view_graph(graph, SolveOptions(method="1O"))
    assert (solution.edge_verdicts[::5] == EdgeVerdict.WATERMARK).all()
    assert _errors(solution, scene).max() < 1e-4


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_neither_the_world_nor_the_order_of_images_and_edges_matters(seed):
    rng = np.random.default_rng(seed)
    scene = ring_scene(15, 5, rotation_sigma=0.01, direction_sigma=0.03, seed=7)
    g = scene.graph
    images, edges = rng.permutation(g.num_images), rng.permutation(g.num_edges)
    new_row = np.argsort(images)
    shuffled = ViewGraph(
        g.image_ids[images],
        new_row[g.edges[edges]],
        g.cam2_from_cam1_rotations[edges],
        g.cam2_in_cam1_directions[edges],
        num_inliers=g.num_inliers[edges],
    )
    options = SolveOptions(method="2O", convergence_tolerance=1e-9)
    a, b = solve_view_graph(g, options), solve_view_graph(shuffled, options)
    errors, _ = align_positions(b.projection_centers[new_row], a.projection_centers)
    assert errors.max() < 1e-5


def test_same_bits_again():
    scene = ring_scene(30, 6, rotation_sigma=0.01, direction_sigma=0.03, outlier_share=0.1)
    a, b = solve_view_graph(scene.graph), solve_view_graph(scene.graph)
    assert a.projection_centers.tobytes() == b.projection_centers.tobytes()
    assert a.cam_from_world_rotations.tobytes() == b.cam_from_world_rotations.tobytes()


def test_rotations_are_certified_on_request():
    scene = ring_scene(25, 6, rotation_sigma=0.02, direction_sigma=0.02, seed=3)
    plain = solve_view_graph(scene.graph, SolveOptions(method="1C", **PAPER))
    assert not plain.caveats
    assert all(entry.stage != "certificate" for entry in plain.log)
    solution = solve_view_graph(scene.graph, SolveOptions(method="1C", certify_rotations=True, **PAPER))
    assert solution.projection_centers.tobytes() == plain.projection_centers.tobytes()
    (said,) = solution.caveats
    assert "are the global optimum" in said
    (entry,) = [entry for entry in solution.log if entry.stage == "certificate"]
    rotations = [entry for entry in solution.log if entry.stage == "rotations"]
    assert abs(entry.change) < 1e-8
    assert entry.cost == pytest.approx(rotations[-1].cost, rel=1e-6)


def test_a_certificate_needs_chordal_rotations():
    scene = ring_scene(25, 6, seed=3)
    solution = solve_view_graph(scene.graph, SolveOptions(method="1C", certify_rotations=True))
    assert "not certified" in solution.caveats[0]


def test_false_pairs_across_a_long_street_neither_fold_it_nor_take_its_images(tmp_path):
    views = synthetic_views("street", 200, num_keypoints=300)
    write_synthetic_database(tmp_path / "database.db", views)
    solution = solve_view_graph(read_view_graph(tmp_path / "database.db"))
    assert solution.registered.all()
    errors, _ = align_positions(solution.projection_centers, views.projection_centers)
    assert errors.max() < 0.2  # metres, of two hundred


def test_the_weighted_form_needs_information():
    scene = ring_scene(12, 4, seed=0)
    with pytest.raises(GraphError, match="2W"):
        solve_view_graph(replace(scene.graph, edge_information=None), SolveOptions(method="2W"))
    informed = replace(scene.graph, edge_information=np.tile(np.eye(5), (scene.graph.num_edges, 1, 1)))
    assert _errors(solve_view_graph(informed, SolveOptions(method="2W")), scene).max() < 1e-8


def _random_view_graph(num_images, degree, sigma, outlier_share, seed=0):
    """Cameras at random places with random edges, some of them with a random pose: true centres and graph."""
    rng = np.random.default_rng(seed)
    R, p = so3.random(num_images, rng), rng.standard_normal((num_images, 3))
    edges = np.stack(np.triu_indices(num_images, 1), axis=1)
    edges = edges[rng.random(len(edges)) < degree / (num_images - 1)]
    i, j = edges.T
    relative = so3.perturbed(R[j] @ np.swapaxes(R[i], 1, 2), sigma, rng)
    directions = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    directions = normalized(directions + sigma * rng.standard_normal(directions.shape))
    wrong = rng.random(len(edges)) < outlier_share
    relative[wrong] = so3.random(int(wrong.sum()), rng)
    directions[wrong] = normalized(rng.standard_normal((int(wrong.sum()), 3)))
    return p, ViewGraph(np.arange(1, num_images + 1), edges, relative, directions)


@pytest.mark.parametrize(
    ("sigma_deg", "outlier_share", "bound"), [(0.0, 0.0, 1e-9), (1.0, 0.0, 0.012), (1.0, 0.3, 0.016)]
)
def test_random_edges_without_matches_are_solved(sigma_deg, outlier_share, bound):
    p, graph = _random_view_graph(150, 20, np.radians(sigma_deg), outlier_share)
    solution = solve_view_graph(graph)
    assert solution.registered.all()
    assert solution.status == "solved"
    errors, _ = align_positions(solution.projection_centers, p)
    assert np.median(errors) < bound * np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))


def test_positions_without_matches_start_from_the_robust_filter(monkeypatch):
    def refuse(*_args, **_options):
        raise AssertionError("CLS repeats what the filter has solved")

    _, graph = _random_view_graph(40, 12, np.radians(1.0), 0.2)
    monkeypatch.setattr(position_stage, "solve_cls", refuse)
    assert solve_view_graph(graph).status == "solved"
    with pytest.raises(AssertionError, match="CLS repeats"):  # without the filter there is no other start
        solve_view_graph(graph, SolveOptions(outlier_filter="none"))
