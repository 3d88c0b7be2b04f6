"""Words that the solver gives to edges and solutions, on graphs in which one thing is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from linked_scenes import near, street, turned, write_scene

from colmap_vg import EdgeVerdict, SolutionStatus, SolveOptions, ViewGraph, read_view_graph, solve_view_graph
from colmap_vg.simulation.ring_scenes import ring_scene

EDGE = 20


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> ViewGraph:
    path = tmp_path_factory.mktemp("verdicts") / "a.db"
    poses, points = street(14, 1)
    write_scene(path, poses, points, near(14, 3), seed=1)
    return read_view_graph(path)


def test_a_pair_whose_pose_and_matches_are_off_contradicts_the_poses(graph: ViewGraph) -> None:
    solution = solve_view_graph(turned(graph, EDGE, 1.5, with_matches=True))
    assert solution.edge_verdicts[EDGE] == EdgeVerdict.CONTRADICTS_POSES
    assert (np.delete(solution.edge_verdicts, EDGE) == EdgeVerdict.KEPT).all()
    assert solution.registered.all()


def test_a_pair_whose_matches_fit_stays_though_its_own_pose_is_off(graph: ViewGraph) -> None:
    # Of two poses that nearly explain a plane's matches, it had the worse one.
    solution = solve_view_graph(turned(graph, EDGE, 1.5, with_matches=False))
    assert (solution.edge_verdicts == EdgeVerdict.KEPT).all()


def test_uncalibrated_pairs_come_back_where_the_rotations_confirm_them(graph: ViewGraph) -> None:
    words = np.full(graph.num_edges, str(EdgeVerdict.KEPT), dtype=object)
    words[[EDGE, EDGE + 1]] = str(EdgeVerdict.UNCALIBRATED)
    doubted = replace(turned(graph, EDGE, 4.0, with_matches=True), read_verdicts=words.astype(str))
    solution = solve_view_graph(doubted)
    assert solution.edge_verdicts[EDGE] == EdgeVerdict.UNCALIBRATED
    assert solution.edge_verdicts[EDGE + 1] == EdgeVerdict.KEPT
    assert not solution.edge_kept[EDGE]
    assert solution.edge_kept[EDGE + 1]


@pytest.mark.parametrize("method", ["1C", "2O"])
def test_a_limit_that_is_reached_is_the_status(method: str) -> None:
    scene = ring_scene(30, 6, rotation_sigma=0.02, direction_sigma=0.05)
    few = solve_view_graph(scene.graph, SolveOptions(method=method, max_num_iterations=1, accelerate=False))
    assert few.status == SolutionStatus.NOT_CONVERGED
    assert not few.converged
    assert "max_num_iterations" in few.message
    assert solve_view_graph(scene.graph, SolveOptions(method=method)).converged
