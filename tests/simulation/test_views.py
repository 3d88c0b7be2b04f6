"""Synthetic views: matches agree with the cameras but for wrong ones in their shares, and COLMAP reads the database."""

import numpy as np
import pytest

from colmap_vg import read_view_graph, solve_view_graph
from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import FOCAL_PX, HEIGHT, WIDTH, synthetic_views
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors


def rays(pixels):
    plane = np.concatenate([(pixels - [WIDTH / 2, HEIGHT / 2]) / FOCAL_PX, np.ones((len(pixels), 1))], axis=1)
    return plane / np.linalg.norm(plane, axis=1, keepdims=True)


def errors_px(views):
    """Sampson errors of each pair's matches under the pair's pose."""
    counts = [len(m) for m in views.matches]
    x1, x2 = (
        np.concatenate(
            [rays(views.keypoints[pair[side]][m[:, side]]) for pair, m in zip(views.pairs, views.matches, strict=True)]
        )
        for side in (0, 1)
    )
    offsets = np.concatenate([[0], np.cumsum(counts)])
    E = essential_from_pose(views.relative_rotations, views.directions)
    return np.abs(sampson_errors(E, offsets, x1, x2)) * FOCAL_PX, np.repeat(np.arange(len(counts)), counts)


@pytest.mark.parametrize("layout", ["street", "ring", "drone"])
def test_matches_agree_with_the_cameras_but_for_the_wrong_ones(layout):
    views = synthetic_views(layout, 40, num_keypoints=300, noise_px=0.3, seed=2)
    errors, pair = errors_px(views)
    right = ~views.wrong[pair]
    assert 0.03 < (errors[right] > 3.0).mean() < 0.07  # a wrong match may lie on the line by chance
    assert np.median(errors[right]) < 0.3
    assert (errors[~right] < 2.0).mean() > 0.98
    assert 0.06 < views.wrong.mean() < 0.10
    i, j = views.pairs[~views.wrong].T
    R = views.cam_from_world_rotations
    np.testing.assert_allclose(views.relative_rotations[~views.wrong], R[j] @ np.swapaxes(R[i], 1, 2), atol=1e-12)
    assert 150 < np.mean([len(k) for k in views.keypoints]) < 600
    assert (views.pairs[:, 0] < views.pairs[:, 1]).all()
    assert len(np.unique(views.pairs, axis=0)) == len(views.pairs)


def test_overlap_does_not_depend_on_the_number_of_images():
    few, many = (synthetic_views("street", n, num_keypoints=400) for n in (60, 240))
    for make in (lambda v: len(v.pairs) / len(v.keypoints), lambda v: np.mean([len(m) for m in v.matches])):
        assert make(many) == pytest.approx(make(few), rel=0.15)


def test_the_same_seed_gives_the_same_views():
    one, two, other = (synthetic_views("drone", 20, num_keypoints=150, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(np.concatenate(one.keypoints), np.concatenate(two.keypoints))
    assert not np.array_equal(one.keypoints[0], other.keypoints[0])


def test_a_database_of_them_is_read_and_solved(tmp_path):
    views = synthetic_views("street", 25, num_keypoints=300)
    write_synthetic_database(tmp_path / "database.db", views)
    graph = read_view_graph(tmp_path / "database.db")
    assert graph.num_images == 25
    assert graph.num_edges == len(views.pairs)
    solution = solve_view_graph(graph)
    assert solution.registered.all()
    errors, similarity = align_positions(solution.projection_centers, views.projection_centers)
    assert errors.mean() < 0.03  # metres; cameras are a metre apart
    turned = solution.cam_from_world_rotations @ similarity.rotation.T
    assert np.degrees(so3.angle(turned @ np.swapaxes(views.cam_from_world_rotations, 1, 2))).max() < 0.5
    kept = {tuple(e) for e in graph.edges[solution.edge_kept]}
    assert not kept & {tuple(p) for p in views.pairs[views.wrong]}


def test_what_makes_no_scene_is_an_error():
    with pytest.raises(OptionError, match="3 or more"):
        synthetic_views("street", 2)
    with pytest.raises(OptionError, match="choose one of street"):
        synthetic_views("plane", 20)
