"""Rotations refined by gravity: closer to the truth, and not harmed by wrong or turned directions."""

import numpy as np
import pytest

from colmap_vg import SolveOptions, ViewGraph, solve_view_graph
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.rotations.gravity import refine_by_gravity
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.scene.pose_priors import PosePriors

N, DEGREE = 60, 8
EDGES = np.sort([(i, (i + k) % N) for i in range(N) for k in range(1, DEGREE // 2 + 1)], axis=1)


def error_deg(rotations: np.ndarray, truth: np.ndarray) -> float:
    """Mean error after the best common rotation."""
    common = so3.project(np.einsum("kba,kbc->ac", rotations, truth)[None])[0]
    return float(np.degrees(so3.angle(np.swapaxes(rotations @ common, 1, 2) @ truth)).mean())


def scene(seed: int, edge_deg: float = 5.0, gravity_deg: float = 1.0) -> tuple[np.ndarray, ...]:
    """True and averaged rotations, relative rotations, and measured gravity."""
    rng = np.random.default_rng(seed)
    truth = so3.random(N, rng)
    i, j = EDGES.T
    relative = so3.perturbed(truth[j] @ np.swapaxes(truth[i], 1, 2), np.radians(edge_deg), rng)
    gravity = normalized(truth @ np.array([0.0, 1.0, 0.0]) + np.radians(gravity_deg) * rng.normal(size=(N, 3)))
    return truth, average_rotations_robust(N, EDGES, relative).cam_from_world_rotations, relative, gravity


def mean_errors(spoil: str, share: float) -> tuple[float, float, list[np.ndarray], list[np.ndarray]]:
    before, after, used, flipped = [], [], [], []
    for seed in range(6):
        truth, averaged, relative, gravity = scene(seed)
        rng = np.random.default_rng(seed + 50)
        rows = rng.permutation(N)[: int(share * N)]
        if spoil == "flip":
            gravity[rows] *= -1.0
        elif spoil == "random":
            gravity[rows] = so3.random(len(rows), rng)[:, 0]
        elif spoil == "missing":
            gravity[rows] = np.nan
        found = refine_by_gravity(N, EDGES, relative, np.ones(len(EDGES)), averaged, gravity)
        before.append(error_deg(averaged, truth))
        after.append(error_deg(found.rotations, truth))
        used.append(found.used)
        flipped.append(np.isin(np.arange(N), rows) == found.flipped)
    return float(np.mean(before)), float(np.mean(after)), used, flipped


@pytest.mark.parametrize(
    ("spoil", "share", "ratio"),
    [("none", 0.0, 0.6), ("flip", 0.3, 0.6), ("random", 0.2, 0.65), ("missing", 0.5, 0.7)],
)
def test_rotations_are_closer_to_the_truth(spoil: str, share: float, ratio: float) -> None:
    before, after, used, flipped = mean_errors(spoil, share)
    assert after < ratio * before
    if spoil == "flip":
        assert np.mean(flipped) > 0.95
    if spoil == "missing":
        assert all(mask.mean() <= 0.5 for mask in used)


def test_directions_at_random_are_not_used() -> None:
    _, averaged, relative, _ = scene(0)
    gravity = so3.random(N, np.random.default_rng(9))[:, 0]
    found = refine_by_gravity(N, EDGES, relative, np.ones(len(EDGES)), averaged, gravity)
    np.testing.assert_array_equal(found.rotations, averaged)
    assert not found.used.any()


def test_exact_edges_are_not_spoilt_by_rough_gravity() -> None:
    truth, averaged, relative, gravity = scene(0, edge_deg=0.01, gravity_deg=5.0)
    found = refine_by_gravity(N, EDGES, relative, np.ones(len(EDGES)), averaged, gravity)
    assert error_deg(found.rotations, truth) < error_deg(averaged, truth) + 0.1


def test_the_solver_uses_it_unless_told_not_to() -> None:
    truth, _, relative, gravity = scene(1)
    gravity[:3] *= -1.0
    gravity[3] = so3.random(1, np.random.default_rng(0))[0, 0]
    rng = np.random.default_rng(2)
    centers = rng.normal(size=(N, 3))
    i, j = EDGES.T
    directions = normalized(np.einsum("kab,kb->ka", truth[i], centers[j] - centers[i]))
    priors = PosePriors(np.full((N, 3), np.nan), np.full((N, 3, 3), np.nan), gravity)
    graph = ViewGraph(np.arange(N), EDGES, relative, directions, priors=priors)
    options = SolveOptions(method="lud", rotation_gate_deg=0.0, direction_gate_deg=0.0, outlier_filter="none")
    found = solve_view_graph(graph, options)
    without = solve_view_graph(graph, SolveOptions(**{**vars(options), "use_prior_gravity": False}))
    assert error_deg(found.cam_from_world_rotations, truth) < 0.7 * error_deg(without.cam_from_world_rotations, truth)
    assert any(caveat.startswith("3 of 60 measured directions of gravity are upside down") for caveat in found.caveats)
    assert any("of 60 measured directions of gravity contradict" in caveat for caveat in found.caveats)
    assert not any("gravity" in caveat for caveat in without.caveats)
