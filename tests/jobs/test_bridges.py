"""What is said of the links between the models of a job."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_vg import SolveOptions, solve_view_graph
from colmap_vg.jobs.bridges import all_bridges
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import ring_scene


@pytest.fixture(scope="module")
def solved() -> tuple[ViewGraph, PoseSolution]:
    scene = ring_scene(10, 6, seed=2)
    names = tuple(f"{k}.jpg" for k in range(10))
    inliers = np.arange(100, 100 + scene.graph.num_edges)
    graph = replace(scene.graph, image_names=names, num_inliers=inliers)
    return graph, solve_view_graph(graph, SolveOptions(method="1O"))


def test_one_model_has_none(solved: tuple[ViewGraph, PoseSolution]) -> None:
    assert all_bridges(*solved) == ()


def test_pairs_between_two_models_are_counted_and_the_strongest_named(solved: tuple[ViewGraph, PoseSolution]) -> None:
    graph, solution = solved
    half = replace(solution, component=np.arange(10) // 5)
    linking = np.flatnonzero((graph.edges // 5).sum(axis=1) == 1)
    (found,) = all_bridges(graph, half)
    assert found.models == (0, 1)
    assert (found.num_pairs, found.num_inliers) == (len(linking), int(graph.num_inliers[linking].sum()))
    order = linking[np.argsort(-graph.num_inliers[linking])]
    assert [pair.images for pair in found.strongest] == [
        tuple(graph.image_names[i] for i in graph.edges[row]) for row in order[:10]
    ]
    assert not found.firm
    assert f"the strongest: {found.strongest[0].images[0]} and {found.strongest[0].images[1]}" in found.told
    assert "add a photograph" in found.told


def test_pairs_that_contradict_the_rest_and_no_pairs_are_told_apart(solved: tuple[ViewGraph, PoseSolution]) -> None:
    graph, solution = solved
    between = (graph.edges // 5).sum(axis=1) == 1
    verdicts = np.where(between, str(EdgeVerdict.ROTATION_OUTLIER), solution.edge_verdicts)
    half = replace(solution, component=np.arange(10) // 5, edge_verdicts=verdicts)
    (found,) = all_bridges(graph, half)
    assert f"{between.sum()} rotation_outlier" in found.told
    apart = replace(solution, component=np.where(np.arange(10) == 0, 0, np.where(np.arange(10) == 5, 1, -1)))
    assert not ((graph.edges == 0).any(axis=1) & (graph.edges == 5).any(axis=1)).any()
    (found,) = all_bridges(graph, apart)
    assert found.num_pairs == 0
    assert found.told.startswith("no pair links models 0 and 1")
