"""The stage of the epipolar adjustment: what it does where dropped pairs leave tracks to hold an image."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from linked_scenes import near, projection_centers, street, turned, write_scene

from colmap_vg import EdgeVerdict, SolveOptions, align_positions, read_view_graph
from colmap_vg.epipolar.problem import epipolar_problem
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.solver.adjustment_stage import adjust_poses
from colmap_vg.solver.part_poses import PartPoses
from colmap_vg.solver.state import SolverState

NUM_IMAGES = 12


def test_tracks_are_sought_again_where_the_dropped_pair_held_an_image(tmp_path: Path) -> None:
    """The last image has two pairs, one of them wrong: without it, directions leave its distance free."""
    poses, points = street(NUM_IMAGES, 3)
    last, right, wrong = NUM_IMAGES - 1, NUM_IMAGES - 2, NUM_IMAGES - 3
    pairs = [*near(last, 3), (wrong, last), (right, last)]
    write_scene(tmp_path / "a.db", poses, points, pairs, seed=3)
    graph = read_view_graph(tmp_path / "a.db")
    row = int(np.flatnonzero((graph.edges == [wrong, last]).all(axis=1))[0])
    graph = turned(graph, row, 3.0, with_matches=True)
    state = SolverState(graph)
    everything = np.ones(NUM_IMAGES, dtype=bool), np.ones(graph.num_edges, dtype=bool)
    part = Subgraph.of(graph.edges, *everything)
    problem = replace(epipolar_problem(graph, part, SolveOptions()), triplets=None)
    truth = projection_centers(poses)
    start = truth.copy()
    start[last] = truth[right] + 1.3 * (truth[last] - truth[right])
    given = PartPoses(np.array([pose.rotation.matrix() for pose in poses]), start, np.ones(1))
    fixed, adjusted = adjust_poses(state, part, problem, given, SolveOptions())
    assert np.flatnonzero(state.edge_verdicts != EdgeVerdict.KEPT).tolist() == [row]
    assert state.edge_verdicts[row] == EdgeVerdict.CONTRADICTS_POSES
    assert fixed.num_images == NUM_IMAGES
    errors, _ = align_positions(adjusted.centers, truth)
    assert errors[last] < 0.02  # of a distance of one between neighbours; without tracks it is 1.7
