"""Components that one pair and measured positions link, with exact poses as the truth."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_vg import PosePriors, SolveOptions, ViewGraph, align_positions, solve_view_graph
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.solver.position_links import link_by_positions

NUM, SIGMA = 7, 0.02
"""Images of each component; standard deviation of the measured positions, whose extent is about 20."""


def scene(seed: int, *, backwards: bool = False) -> tuple[ViewGraph, np.ndarray, np.ndarray]:
    """Two complete graphs with one pair between them, and the true rotations and centres."""
    rng = np.random.default_rng(seed)
    R = so3.exp(0.3 * rng.standard_normal((2 * NUM, 3)))
    centers = np.stack([3.0 * np.arange(2 * NUM), *rng.standard_normal((2, 2 * NUM))], axis=1)
    first, second = np.triu_indices(NUM, 1)
    edges = np.concatenate([np.stack([first, second], 1), NUM + np.stack([first, second], 1), [[NUM - 1, NUM]]])
    if backwards:
        edges = edges[:, ::-1]
    i, j = edges.T
    graph = ViewGraph(
        np.arange(2 * NUM),
        edges,
        R[j] @ np.swapaxes(R[i], 1, 2),
        normalized(np.einsum("kab,kb->ka", R[i], centers[j] - centers[i])),
        num_inliers=np.full(len(edges), 100),
        priors=PosePriors(
            1000.0 + 2.0 * centers @ so3.exp(np.array([0.1, 2.0, 0.3])).T + SIGMA * rng.standard_normal(centers.shape),
            np.full((2 * NUM, 3, 3), np.nan),
            np.full((2 * NUM, 3), np.nan),
        ),
    )
    return graph, R, centers


def in_own_frames(R: np.ndarray, centers: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of both components, each in a frame and scale of its own."""
    rng = np.random.default_rng(seed)
    component = np.repeat([0, 1], NUM)
    turns, scales, shifts = so3.exp(rng.standard_normal((2, 3))), rng.uniform(0.3, 3.0, 2), rng.standard_normal((2, 3))
    moved = scales[component, None] * np.einsum("kab,kb->ka", turns[component], centers) + shifts[component]
    return R @ np.swapaxes(turns, 1, 2)[component], moved, component


def all_edges(graph: ViewGraph) -> np.ndarray:
    return np.ones(graph.num_edges, dtype=bool)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("share_wrong", [0.0, 0.25])
def test_linked_components_have_true_poses(seed: int, backwards: bool, share_wrong: float) -> None:
    graph, R, centers = scene(seed, backwards=backwards)
    wrong = np.random.default_rng(seed).permutation(2 * NUM)[: int(share_wrong * 2 * NUM)]
    wrong = np.array([w for w in wrong if (wrong // NUM == w // NUM).sum() <= 2], dtype=int)
    graph.priors.positions[wrong] += 500.0
    rotations, moved, component = in_own_frames(R, centers, seed)
    linked = link_by_positions(graph, all_edges(graph), rotations, moved, component)
    assert (linked == 0).all()
    errors, similarity = align_positions(moved, centers)
    assert errors.max() < 5.0 * SIGMA
    # The rotation between the components is the pair's, which is exact.
    np.testing.assert_allclose(rotations @ similarity.rotation.T, R, atol=2.0 * SIGMA)
    relative = rotations[NUM] @ rotations[NUM - 1].T
    np.testing.assert_allclose(relative, R[NUM] @ R[NUM - 1].T, atol=1e-9)


@pytest.mark.parametrize(
    "fault", ["rotation", "direction", "reversed", "no positions", "uncertain", "dropped", "most wrong", "small"]
)
def test_nothing_is_linked_without_evidence(fault: str) -> None:
    graph, R, centers = scene(1)
    usable, link = all_edges(graph), graph.num_edges - 1
    if fault == "rotation":
        graph.cam2_from_cam1_rotations[link] = so3.exp(np.array([0.0, 0.5, 0.0])) @ graph.cam2_from_cam1_rotations[link]
    elif fault == "direction":
        graph.cam2_in_cam1_directions[link] = normalized(np.array([[0.1, 1.0, 0.3]]))[0]
    elif fault == "reversed":
        graph.cam2_in_cam1_directions[link] *= -1.0
    elif fault == "most wrong":
        off = np.array([0.0, 0.0, 30.0])  # whose effects cancel each other
        graph.priors.positions[[NUM, NUM + 3]] += off
        graph.priors.positions[[NUM + 1, NUM + 2]] -= off
    elif fault == "small":  # the second component is as large as the positions are uncertain
        near = graph.priors.positions[NUM].copy()
        graph.priors.positions[NUM:] = near + 2e-3 * (graph.priors.positions[NUM:] - near)
        centers[NUM:] = centers[NUM] + 2e-3 * (centers[NUM:] - centers[NUM])
    elif fault == "no positions":
        graph.priors.positions[NUM + 2 :] = np.nan
    elif fault == "uncertain":
        graph.priors.positions[:] += 20.0 * np.random.default_rng(0).standard_normal((2 * NUM, 3))
    else:
        usable[link] = False
    rotations, moved, component = in_own_frames(R, centers, 1)
    before = rotations.copy(), moved.copy()
    assert link_by_positions(graph, usable, rotations, moved, component).tolist() == component.tolist()
    np.testing.assert_array_equal(rotations, before[0])
    np.testing.assert_array_equal(moved, before[1])


def test_a_chain_is_solved_with_positions_and_not_without() -> None:
    graph, _, centers = scene(2)
    options = SolveOptions(method="2O")
    alone = solve_view_graph(replace(graph, priors=None), options)
    assert alone.registered.sum() == NUM
    solution = solve_view_graph(graph, options)
    assert solution.registered.all()
    assert align_positions(solution.projection_centers, centers)[0].max() < 5.0 * SIGMA
    assert any("their scale is that of the measured positions" in caveat for caveat in solution.caveats)
    assert solution.edge_kept.all()


@pytest.mark.parametrize("verdict", ["excluded", "rotation_only", "no_pose"])
def test_pairs_without_a_direction_link_nothing(verdict: str) -> None:
    graph, _, _ = scene(2)
    verdicts = np.full(graph.num_edges, "kept", dtype="<U20")
    verdicts[-1] = verdict
    solution = solve_view_graph(replace(graph, read_verdicts=verdicts), SolveOptions(method="2O"))
    assert sorted(np.bincount(solution.component).tolist()) == [NUM, NUM]
