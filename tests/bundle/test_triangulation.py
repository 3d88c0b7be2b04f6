"""Points of matched keypoints with known poses: exact, as least squares tell them, apart where matches are false."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from triangulation_scenes import NUM_IMAGES, NUM_POINTS, matched_ring

from colmap_vg.bundle import triangulation
from colmap_vg.bundle.tracks import MatchedRays
from colmap_vg.bundle.triangulation import nearest_points, triangulate
from colmap_vg.geometry.directions import normalized

WIDE = np.radians(1.5)


def test_points_of_exact_rays_are_exact() -> None:
    seen, _, points = matched_ring()
    found = triangulate(seen, WIDE)
    assert found.positions.shape == (3, NUM_POINTS)
    np.testing.assert_allclose(found.positions[:, found.point_row].T, np.tile(points, (NUM_IMAGES, 1)), atol=1e-9)


def test_points_have_the_least_sum_of_squared_sines() -> None:
    seen, _, points = matched_ring(noise=3e-3)
    track = np.tile(np.arange(NUM_POINTS), NUM_IMAGES)
    centers = seen.centers[:, seen.image_row]
    found = nearest_points(seen.rays, centers, track, NUM_POINTS)
    for point in range(5):
        own = track == point

        def sines(x: np.ndarray, own: np.ndarray = own) -> np.ndarray:
            return np.cross(normalized(x - centers[:, own].T), seen.rays[:, own].T).ravel()

        best = least_squares(sines, points[point], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        # Far below the error of the points themselves, which is 5e-3.
        np.testing.assert_allclose(found[:, point], best, atol=3e-4)


@pytest.mark.parametrize("false_share", [0.1, 0.3])
def test_false_matches_neither_join_points_nor_lose_them(false_share: float) -> None:
    seen, _, points = matched_ring(false_share=false_share, noise=5e-4)
    found = triangulate(seen, WIDE)
    used = found.point_row >= 0
    assert used.mean() > 0.97
    of_point = np.tile(np.arange(NUM_POINTS), NUM_IMAGES)
    errors = np.linalg.norm(found.positions[:, found.point_row[used]].T - points[of_point[used]], axis=1)
    # A wrong ray may pass a point within two degrees, a sixth of its distance from others here.
    assert np.median(errors) < 5e-3
    assert np.mean(errors < 0.1) > 0.97


def test_tracks_joined_by_a_match_that_both_points_explain_are_taken_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """No depth tells that matches are false here: the tracks are joined, and the rays tell the points."""
    seen, _, points = matched_ring()
    rays = seen.rays.reshape(3, NUM_IMAGES, NUM_POINTS)
    apart = np.degrees(np.arccos(np.einsum("aip,aiq->ipq", rays, rays).max(axis=0).clip(-1.0, 1.0)))
    one, other = np.nonzero(np.triu(apart > 5.0, 1))
    joined = np.stack([one, other + 7 * NUM_POINTS])[:, ::20]
    assert joined.shape[1] > 15
    seen = replace(seen, matches=np.concatenate([seen.matches, joined], axis=1))
    monkeypatch.setattr(triangulation, "consistent_matches", lambda given: np.ones(given.matches.shape[1], bool))
    found = triangulate(seen, WIDE)
    assert (found.point_row >= 0).all()
    assert found.positions.shape == (3, NUM_POINTS)
    np.testing.assert_allclose(found.positions[:, found.point_row].T, np.tile(points, (NUM_IMAGES, 1)), atol=1e-9)


def test_a_point_takes_one_keypoint_of_an_image_the_nearest() -> None:
    seen, _, points = matched_ring()
    k = len(seen.image_row)
    again = normalized((points[3] + [0.0, 0.02, 0.0] - seen.centers[:, 0])[None])
    seen = MatchedRays(
        np.append(seen.image_row, 0),
        np.concatenate([seen.rays, again.T], axis=1),
        seen.centers,
        np.concatenate([seen.matches, [[k, k], [2 * NUM_POINTS + 3, 4 * NUM_POINTS + 3]]], axis=1),
    )
    found = triangulate(seen, WIDE)
    assert found.point_row[k] == -1
    assert len(np.unique(found.point_row[3:k:NUM_POINTS])) == 1
    # The second keypoint pulled at the point before it was left out, but no longer does.
    np.testing.assert_allclose(found.positions[:, found.point_row[3]], points[3], atol=1e-9)


def test_two_keypoints_matched_to_each_other_only_make_no_point() -> None:
    seen, _, _ = matched_ring()
    one, other = seen.matches
    lonely = (one % NUM_POINTS == 0) & ~((one == 0) & (other == 4 * NUM_POINTS))
    found = triangulate(replace(seen, matches=seen.matches[:, ~lonely]), WIDE)
    assert (found.point_row[::NUM_POINTS] == -1).all()
    assert (np.delete(found.point_row.reshape(NUM_IMAGES, -1), 0, axis=1) >= 0).all()


def test_points_without_parallax_or_behind_the_images_are_left_out() -> None:
    seen, _, points = matched_ring()
    near = seen.matches[:, (seen.image_row[seen.matches] < 3).all(axis=0)]
    rays = seen.rays.reshape(3, NUM_IMAGES, NUM_POINTS)
    widest = np.arccos(np.einsum("aip,ajp->pij", rays[:, :3], rays[:, :3]).min(axis=(1, 2)))
    limit = float(np.median(widest))
    assert limit < np.radians(80.0)
    found = triangulate(replace(seen, matches=near), limit)
    of_points = np.linalg.norm(found.positions.T[:, None] - points, axis=2).argmin(axis=1)
    np.testing.assert_allclose(found.positions.T, points[of_points], atol=1e-9)
    # The ray farthest from the farthest of one is not always one of the two that are farthest apart.
    assert (widest[of_points] >= limit).all()
    assert NUM_POINTS / 2 >= len(np.unique(of_points)) == len(of_points) >= NUM_POINTS / 2 - 3
    behind = triangulate(replace(seen, rays=-seen.rays), WIDE)
    assert behind.positions.shape == (3, 0)


def test_points_between_two_images_are_left_out() -> None:
    centers = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    for height, kept in ((1e-3, 0), (0.5, 1)):
        rays = normalized(np.array([0.0, height, 0.0]) - centers)
        seen = MatchedRays(np.arange(3), rays.T.copy(), centers.T.copy(), np.array([[0, 0], [1, 2]]))
        assert triangulate(seen, WIDE).positions.shape[1] == kept


def test_keypoints_without_matches_and_none_at_all() -> None:
    seen, _, _ = matched_ring()
    found = triangulate(replace(seen, matches=np.zeros((2, 0), dtype=np.int64)), WIDE)
    assert found.positions.shape == (3, 0)
    assert (found.point_row == -1).all()


@pytest.mark.filterwarnings("error")
def test_a_point_at_a_projection_centre_does_not_overflow() -> None:
    centers = np.zeros((8, 3))
    centers[:2, 0] = [-1.0, 1.0]
    rays = np.tile(normalized(np.array([1.0, 2.0, 3.0])), (8, 1))
    rays[:2] = -centers[:2]
    found = nearest_points(rays.T.copy(), centers.T.copy(), np.zeros(8, dtype=np.int64), 1)
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-9)
