"""The graph of Fig. 4: its noise, the test of the rhombus, and who falls for it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg import SolveOptions, solve_view_graph
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between, normalized
from colmap_vg.simulation.six_vertices import SIX_CENTERS, SIX_EDGES, inner_cameras_outside, six_vertex_scene


def test_directions_are_wrong_by_five_degrees():
    true = normalized(SIX_CENTERS[SIX_EDGES[:, 1]] - SIX_CENTERS[SIX_EDGES[:, 0]])
    draws = [six_vertex_scene(seed=seed).graph.cam2_in_cam1_directions for seed in range(20)]
    for directions in draws:
        assert np.degrees(angle_between(directions, true)) == pytest.approx(5.0)
    assert len({d.tobytes() for d in draws}) > 10
    assert draws[3].tobytes() == six_vertex_scene(seed=3).graph.cam2_in_cam1_directions.tobytes()


def test_noise_free_graph_is_rigid():
    scene = six_vertex_scene(0.0)
    solution = solve_view_graph(scene.graph, SolveOptions(method="cross"))
    assert solution.registered.all()
    assert not inner_cameras_outside(solution.projection_centers).any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-2, 1e2))
def test_outside_is_seen_in_any_gauge(seed, scale):
    rng = np.random.default_rng(seed)
    turn, shift = so3.random(1, rng)[0], rng.standard_normal(3)
    centers = SIX_CENTERS.copy()
    centers[4], centers[5] = [1.2, 0.1, 0.3], [0.8, -0.1, -0.3]
    assert inner_cameras_outside(scale * centers @ turn.T + shift).tolist() == [True, False]


@pytest.mark.parametrize(
    ("method", "low", "high"),
    [("cross", 0.5, 1.0), ("shapefit", 0.5, 1.0), ("cls", 0.0, 0.02), ("1C", 0.0, 0.02), ("1O", 0.0, 0.02)],
)
def test_the_orthogonal_metric_puts_inner_cameras_outside_and_the_chordal_one_does_not(method, low, high):
    options = SolveOptions(
        method=method,
        rotation_averaging="chordal",
        rotation_gate_deg=0.0,
        outlier_filter="none",
        max_num_iterations=200,
    )
    outside = [
        inner_cameras_outside(solve_view_graph(six_vertex_scene(seed=seed).graph, options).projection_centers).any()
        for seed in range(20)
    ]
    assert low <= np.mean(outside) <= high
