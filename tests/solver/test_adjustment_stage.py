"""The stage of the epipolar adjustment: tracks that hold an image whose pair is dropped, and the radial term."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from image_sets import FOCAL, image_set
from linked_scenes import near, projection_centers, street, turned, write_scene

from colmap_vg import EdgeVerdict, SolveOptions, ViewGraph, align_positions, read_view_graph
from colmap_vg.epipolar.adjustment import AdjustmentResult, adjust_epipolar
from colmap_vg.epipolar.cameras import Cameras
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses, epipolar_problem
from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.solver import adjustment_stage
from colmap_vg.solver.adjustment_stage import adjust_poses
from colmap_vg.solver.part_poses import PartPoses
from colmap_vg.solver.state import SolverState

NUM_IMAGES = 12


def tolerances_asked(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The tolerances with which the epipolar adjustment is called from here on."""
    asked: list[float] = []

    def adjusted(*arguments: Any, tolerance: float, **options: Any) -> AdjustmentResult:
        asked.append(tolerance)
        return adjust_epipolar(*arguments, tolerance=tolerance, **options)

    monkeypatch.setattr(adjustment_stage, "adjust_epipolar", adjusted)
    return asked


def test_tracks_are_sought_again_where_the_dropped_pair_held_an_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last image has two pairs, one of them wrong: without it, directions leave its distance free."""
    poses, points = street(NUM_IMAGES, 3)
    last, right, wrong = NUM_IMAGES - 1, NUM_IMAGES - 2, NUM_IMAGES - 3
    pairs = [*near(last, 3), (wrong, last), (right, last)]
    write_scene(tmp_path / "a.db", poses, points, pairs, seed=3)
    graph = read_view_graph(tmp_path / "a.db")
    row = int(np.flatnonzero((graph.edges == [wrong, last]).all(axis=1))[0])
    graph = turned(graph, row, 5.0, with_matches=True)
    state = SolverState(graph)
    everything = np.ones(NUM_IMAGES, dtype=bool), np.ones(graph.num_edges, dtype=bool)
    part = Subgraph.of(graph.edges, *everything)
    problem = replace(epipolar_problem(graph, part, SolveOptions()), triplets=None)
    truth = projection_centers(poses)
    start = truth.copy()
    start[last] = truth[right] + 1.3 * (truth[last] - truth[right])
    given = PartPoses(np.array([pose.rotation.matrix() for pose in poses]), start, np.ones(1))
    asked = tolerances_asked(monkeypatch)
    fixed, adjusted = adjust_poses(state, part, problem, given, SolveOptions(adjustment_tolerance=1e-6))
    assert asked == [1e-6, 1e-6]
    assert np.flatnonzero(state.edge_verdicts != EdgeVerdict.KEPT).tolist() == [row]
    assert state.edge_verdicts[row] == EdgeVerdict.CONTRADICTS_POSES
    assert fixed.num_images == NUM_IMAGES
    errors, _ = align_positions(adjusted.centers, truth)
    assert errors[last] < 0.02  # of a distance of one between neighbours; without tracks it is 1.7


def bent_graph(focals: list[float], radial: list[bool], term: float = 0.0) -> tuple[ViewGraph, PartPoses]:
    """A street, its images by the cameras in turn, all of unknown focal length; the first camera has a radial term."""
    problem, R, p = image_set(2, "street", NUM_IMAGES, 1500, 0.3)
    camera, edge = (
        np.arange(NUM_IMAGES) % len(focals),
        np.repeat(np.arange(len(problem.edges)), np.diff(problem.offsets)),
    )
    rays = []
    for side, own in enumerate((problem.bearings1, problem.bearings2)):
        u = own[:, :2] / own[:, 2:]
        has_term = camera[problem.edges[edge, side]] == 0
        u = u * (1.0 + term * has_term[:, None] * np.sum(u**2, axis=1, keepdims=True))
        rays.append(normalized(np.concatenate([u, np.ones((len(u), 1))], axis=1)))
    rotations, directions, _ = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)
    graph = ViewGraph(
        np.arange(1, NUM_IMAGES + 1),
        problem.edges,
        rotations,
        directions,
        np.diff(problem.offsets),
        camera,
        camera_ids=np.arange(1, len(focals) + 1),
        camera_focal_lengths=np.array(focals),
        camera_focal_known=np.zeros(len(focals), dtype=bool),
        camera_radial=np.array(radial),
        inlier_offsets=problem.offsets,
        inlier_bearings1=rays[0],
        inlier_bearings2=rays[1],
        inlier_keypoints1=problem.keypoints1,
        inlier_keypoints2=problem.keypoints2,
    )
    return graph, PartPoses(R, p, np.ones(len(focals)))


def whole(graph: ViewGraph) -> tuple[Subgraph, EpipolarProblem]:
    part = Subgraph.of(graph.edges, np.ones(graph.num_images, dtype=bool), np.ones(graph.num_edges, dtype=bool))
    problem = epipolar_problem(graph, part, SolveOptions())
    assert problem is not None
    return part, problem


def test_matches_and_tracks_are_as_many_as_asked_for() -> None:
    graph, _ = bent_graph([FOCAL, FOCAL], [False, False], term=0.0)
    part = Subgraph.of(graph.edges, np.ones(graph.num_images, dtype=bool), np.ones(graph.num_edges, dtype=bool))
    for options in ({}, {"max_matches_per_edge": 20}, {"max_tracks_per_triplet": 7}):
        problem = epipolar_problem(graph, part, SolveOptions(**options))
        assert problem is not None
        assert problem.triplets is not None
        assert (np.diff(problem.offsets).max() <= 20) == ("max_matches_per_edge" in options)
        assert (np.diff(problem.triplets.offsets).max() <= 7) == ("max_tracks_per_triplet" in options)


def test_the_radial_term_is_that_of_the_cameras_that_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    # Groups are in the order of focal lengths, unlike the cameras.
    graph, poses = bent_graph([1.01 * FOCAL, FOCAL, FOCAL], [True, False, False], term=-0.1)
    part, problem = whole(graph)
    # Pairs are computed from distorted rays, so that a comparison with the poses would mean nothing.
    monkeypatch.delattr(adjustment_stage, "_contradicting")
    asked = tolerances_asked(monkeypatch)
    _, adjusted = adjust_poses(SolverState(graph), part, problem, poses, SolveOptions(adjustment_tolerance=1e-6))
    assert asked == [1e-6, 1e-6]
    assert adjusted.radial_terms is not None
    assert adjusted.radial_terms[0] == pytest.approx(-0.1, abs=0.01)
    np.testing.assert_array_equal(adjusted.radial_terms[1:], 0.0)


@pytest.mark.parametrize(
    ("focals", "radial", "lost", "tried"),
    [
        ([900.0, FOCAL], [True, False], [False, False], [True, False]),
        ([FOCAL, 900.0], [True, True], [True, False], [False, True]),  # groups are in the order of focal lengths
        ([FOCAL, FOCAL], [True, False], [False], None),
        ([900.0, FOCAL], [False, False], [False, False], None),
    ],
    ids=["has none", "lost", "group of both kinds", "none has one"],
)
def test_a_term_is_sought_for_cameras_that_may_have_one(
    focals: list[float],
    radial: list[bool],
    lost: list[bool],
    tried: list[bool] | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph, poses = bent_graph(focals, radial)
    _, problem = whole(graph)
    found = adjust_epipolar(problem, poses.rotations, poses.centers, graph.cam2_in_cam1_directions)
    asked: list[np.ndarray] = []

    def fit(problem: EpipolarProblem, start: AdjustmentResult, bent_cameras: np.ndarray) -> None:
        asked.append(bent_cameras)

    monkeypatch.setattr(adjustment_stage, "fit_radial_term", fit)
    found = replace(found, lost_focals=np.array(lost))
    adjustment_stage._with_radial_term(SolverState(graph), problem, found, graph.cam2_in_cam1_directions, 1e-5)
    assert [mask.tolist() for mask in asked] == ([] if tried is None else [tried])
