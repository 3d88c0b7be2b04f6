"""False matches found by the depths that a keypoint's matches tell, and tracks as connected components."""

import numpy as np
import pytest
from triangulation_scenes import matched_ring

from colmap_vg.bundle import tracks
from colmap_vg.bundle.tracks import MatchedRays, connected_tracks, consistent_matches
from colmap_vg.geometry.directions import normalized


@pytest.mark.parametrize(("false_share", "least"), [(0.1, 0.995), (0.3, 0.95)])
def test_right_matches_are_kept_and_false_ones_are_not(false_share: float, least: float) -> None:
    """Of the seven matches of a keypoint most may be false: one in eight with a share of 0.3."""
    seen, true, _ = matched_ring(false_share, noise=1e-3)
    kept = consistent_matches(seen)
    assert kept[true].mean() > least
    assert kept[~true].mean() < 0.1


def test_a_false_match_on_its_epipolar_line_is_not_kept() -> None:
    seen, _, points = matched_ring()
    # Image 1 sees a point farther along the ray of image 0's first keypoint, and they are matched.
    k, farther = len(seen.image_row), points[0] + 0.7 * seen.rays[:, 0]
    ray = normalized((farther - seen.centers[:, 1])[None]).T
    kept = consistent_matches(
        MatchedRays(
            np.append(seen.image_row, 1),
            np.concatenate([seen.rays, ray], axis=1),
            seen.centers,
            np.concatenate([seen.matches, [[0], [k]]], axis=1),
        )
    )
    assert kept[:-1].all()
    assert not kept[-1]


def test_matches_of_rays_that_hardly_move_do_not_outvote_the_others() -> None:
    """Two of a keypoint's three matches are of images beside it, whose noise alone gives depths of any size."""
    point = np.array([0.0, 0.0, 10.0])
    centers = np.array([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0], [4.0, 0.0, 0.0]])
    rays = normalized(point - centers)
    rays[1:3] = normalized(rays[1:3] + np.array([[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0]]))
    matches = np.array([[0, 0, 0], [1, 2, 3]])
    assert consistent_matches(MatchedRays(np.arange(4), rays.T.copy(), centers.T.copy(), matches)).all()


@pytest.mark.filterwarnings("error")
def test_parallel_rays_and_rays_along_the_baseline_are_no_error() -> None:
    centers = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]).T
    ahead = np.tile([[0.0], [0.0], [1.0]], 4)
    matches = np.array([[0, 0, 2], [1, 2, 3]])  # along the baseline, parallel, without a baseline
    found = consistent_matches(MatchedRays(np.arange(4), ahead, centers, matches))
    assert found[1]  # a point at infinity
    assert found.shape == (3,)
    nothing = MatchedRays(np.zeros(0, int), np.zeros((3, 0)), np.zeros((3, 0)), np.zeros((2, 0), int))
    assert consistent_matches(nothing).shape == (0,)


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, _, _ = matched_ring(false_share=0.3, noise=1e-2)
    at_once = consistent_matches(seen)
    monkeypatch.setattr(tracks, "BLOCK", 7)
    np.testing.assert_array_equal(consistent_matches(seen), at_once)


def test_weighted_medians_are_those_by_definition() -> None:
    rng = np.random.default_rng(0)
    segment = rng.integers(0, 30, 400)
    values = rng.standard_cauchy(400).astype(np.float32)
    values[::17], values[5::31] = np.inf, np.nan
    weights = rng.uniform(0.1, 5.0, 400).astype(np.float32)
    found = tracks._weighted_medians(segment, values, weights, 32)
    for one in range(30):
        own = np.flatnonzero((segment == one) & np.isfinite(values))
        own = own[np.argsort(values[own])]
        half = np.searchsorted(np.cumsum(weights[own], dtype=float), 0.5 * weights[own].sum(dtype=float))
        assert found[one] == values[own[half]]
    assert np.isnan(found[30:]).all()


def test_tracks_are_connected_components() -> None:
    found = connected_tracks(np.array([[0, 2, 7], [5, 5, 8]]), 10)
    assert found[0] == found[2] == found[5] >= 0
    assert found[7] == found[8] >= 0
    assert found[7] != found[0]
    assert (found[[1, 3, 4, 6, 9]] == -1).all()


@pytest.mark.parametrize("side", [0, 1])
def test_a_change_of_inverse_depth_times_its_lever_is_an_angle_between_the_rays(side: int) -> None:
    centers = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]])
    point = np.array([1.0, 0.0, 4.0])  # nearly ahead of the second camera, along the baseline of neither
    rays = normalized(point - centers)
    seen = MatchedRays(np.arange(2), rays.T.copy(), centers.T.copy(), np.array([[0], [1]]))
    (inverse,), (lever,) = (pair[side] for pair in tracks._inverse_depths(seen, seen.matches))
    assert inverse == pytest.approx(1.0 / np.linalg.norm(point - centers[side]))
    angle, other = 1e-6, 1 - side
    rays[other] += angle * np.cross([0.0, 1.0, 0.0], rays[other])  # in the plane of both rays
    turned = MatchedRays(np.arange(2), rays.T.copy(), centers.T.copy(), seen.matches)
    (moved,) = tracks._inverse_depths(turned, seen.matches)[0][side]
    parallax = np.arccos(rays[0] @ rays[1])
    # It is the sine of the angle that is linear in the inverse depth.
    assert abs(moved - inverse) * lever == pytest.approx(angle, rel=0.2)
    assert parallax < 0.4


@pytest.mark.filterwarnings("error")
def test_rays_from_one_place_contradict_nothing() -> None:
    """As those of the sensors of a cube: the third image tells the depth, and the two agree with any."""
    point = np.array([0.0, 1.0, 8.0])
    centers = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    rays = normalized(point - centers)
    rays[1] = normalized(rays[1] + np.array([1e-3, 0.0, 0.0]))
    matches = np.array([[0, 0], [1, 2]])
    assert consistent_matches(MatchedRays(np.arange(3), rays.T.copy(), centers.T.copy(), matches)).all()
    alone = MatchedRays(np.arange(3), rays.T.copy(), centers.T.copy(), matches[:, :1])
    assert consistent_matches(alone).all()
