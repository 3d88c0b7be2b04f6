"""A radial term: taken out of rays exactly, with its derivative; found where it is, and carried to the camera."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from image_sets import FOCAL, image_set

from colmap_vg import align_positions
from colmap_vg.colmap_io.cameras import has_radial_term, with_radial_term
from colmap_vg.epipolar.adjustment import adjust_epipolar
from colmap_vg.epipolar.cameras import Cameras
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.epipolar.radial_term import fit_radial_term
from colmap_vg.geometry.directions import normalized
from colmap_vg.two_view.radial_distortion import undistorted_rays

ALL = np.array([True])


def shown(rays: np.ndarray, term: float) -> np.ndarray:
    """Rays as a lens with a radial term shows them."""
    u = rays[:, :2] / rays[:, 2:]
    bent = u * (1.0 + term * np.sum(u**2, axis=1, keepdims=True))
    return normalized(np.concatenate([bent, np.ones((len(u), 1))], axis=1))


def bent(problem: EpipolarProblem, term: float) -> EpipolarProblem:
    triplets = problem.triplets
    bearings = np.stack([shown(rays.T, term).T for rays in triplets.bearings])
    return replace(
        problem,
        bearings1=shown(problem.bearings1, term),
        bearings2=shown(problem.bearings2, term),
        triplets=replace(triplets, bearings=bearings),
    )


def padded(rays: np.ndarray) -> np.ndarray:
    """Rays (k, 3) as two pieces with padding."""
    return np.stack([np.pad(half.T, ((0, 0), (0, 3))) for half in np.array_split(rays[: len(rays) // 2 * 2], 2)])


@pytest.mark.parametrize("term", [-0.2, 0.15])
def test_a_term_is_taken_out_exactly_where_a_camera_has_it(term: float) -> None:
    rays = padded(image_set(0, "ring", 8, 300, 0.5)[0].bearings1)
    bent = np.stack([np.pad(shown(piece[:, :-3].T, term).T, ((0, 0), (0, 3))) for piece in rays])
    straight, _ = undistorted_rays(bent, term, np.array([True, False]))
    np.testing.assert_allclose(straight[0], rays[0], atol=1e-9)
    np.testing.assert_allclose(straight[1], bent[1], atol=1e-15)


@pytest.mark.parametrize("term", [-0.2, 0.0, 0.15])
def test_gains_are_shifts_by_the_term_over_those_by_the_focal_length(term: float) -> None:
    rays, all_of_them = padded(image_set(0, "ring", 8, 300, 0.5)[0].bearings1), np.ones(2, dtype=bool)
    (ahead, _), (behind, _), (straight, gains) = (
        undistorted_rays(rays, term + step, all_of_them) for step in (1e-5, -1e-5, 0.0)
    )
    z = straight[:, 2:]
    by_focal = z * (np.array([0.0, 0.0, 1.0])[:, None] - z * straight)
    np.testing.assert_allclose((ahead - behind) / 2e-5, gains[:, None] * by_focal, atol=1e-7)


def test_rays_off_the_axis_and_beyond_a_maximum_stay_finite() -> None:
    wide = normalized(np.array([[1.0, 0.0, -0.2], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.1]]))
    straight, gains = undistorted_rays(wide.T[None], -0.5, np.array([True]))
    assert np.isfinite(straight).all()
    assert np.isfinite(gains).all()
    np.testing.assert_allclose(straight[0].T[[0, 2, 3]], wide[[0, 2, 3]])
    np.testing.assert_array_equal(gains[0, [0, 1, 2, 3]], 0.0)


def test_only_cameras_with_the_term_are_undistorted() -> None:
    problem, *_ = image_set(1, "ring", 8, 300, 0.5, free=True)
    camera = np.arange(8) % 2
    two = {"camera_idx": camera, "focal_lengths": np.full(2, FOCAL), "free_focals": np.ones(2, dtype=bool)}
    straight, lenses = replace(problem, **two), Lenses(np.zeros(2), -0.2)
    curved = replace(bent(straight, lenses.radial_term), bent_cameras=np.array([True, False]))

    def rays_of(seen: EpipolarProblem) -> tuple:
        return seen.matches(lenses), seen.triplet_rays(seen.triplets, lenses)

    images = straight.edges.T, straight.triplets.images.T
    problems = curved, straight, replace(curved, bent_cameras=None)
    for own, found, before, as_seen in zip(images, *map(rays_of, problems), strict=True):
        for side, seen_by in enumerate(camera[own[:, found.pieces.segments]]):
            columns = slice(3 * side, 3 * side + 3)
            expected = np.where((seen_by == 0)[:, None, None], before.pieces.columns, as_seen.pieces.columns)
            np.testing.assert_allclose(found.pieces.columns[:, columns], expected[:, columns], atol=1e-9)
            assert (found.radial_gains[seen_by == 0, side].max(axis=1) > 0.0).all()
            np.testing.assert_array_equal(found.radial_gains[seen_by == 1, side], 0.0)


def test_the_term_of_a_bent_lens_is_found_with_its_focal_length_and_positions() -> None:
    problem, R, p = image_set(2, "street", 16, 2500, 0.3, free=True)
    curved = bent(problem, -0.1)
    directions = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1]
    without = adjust_epipolar(curved, R, p, directions)
    found = fit_radial_term(curved, without, ALL)
    assert found is not None
    assert abs(found.result.radial_term + 0.1) < 0.01
    assert abs(np.log(found.result.focal_scales[0])) < 0.01
    error, before = (align_positions(r.projection_centers, p)[0].mean() for r in (found.result, without))
    assert error < 0.1 * before


def test_a_long_street_of_a_bent_lens_is_adjusted_in_a_few_steps() -> None:
    """The term, the focal length and the bend of the street trade off: 72 steps that are linear in single poses."""
    problem, R, p = image_set(2, "street", 60, 2500, 0.3, free=True)
    curved = bent(problem, -0.1)
    directions = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1]
    start = Lenses(np.array([0.18]))
    without = adjust_epipolar(curved, R, p, directions, initial_lenses=start)
    found = fit_radial_term(curved, without, ALL)
    assert found is not None
    assert abs(found.result.radial_term + 0.1) < 0.01
    assert len(without.log) + len(found.result.log) <= 40


def test_a_straight_lens_gets_none() -> None:
    problem, R, p = image_set(3, "ring", 12, 600, 0.5, free=True)
    directions = Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1]
    assert fit_radial_term(problem, adjust_epipolar(problem, R, p, directions), ALL) is None


def test_the_camera_shows_what_the_term_says() -> None:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=[FOCAL, 500.0, 400.0, 0.0])
    assert has_radial_term(camera)
    assert not has_radial_term(pycolmap.Camera(model="PINHOLE", width=10, height=8, params=[9.0, 9.0, 5.0, 4.0]))
    rays = normalized(np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]]))
    expected = shown(rays, -0.07)
    pixels = with_radial_term(camera, -0.07).img_from_cam(rays)
    np.testing.assert_allclose(pixels, FOCAL * expected[:, :2] / expected[:, 2:] + [500.0, 400.0], atol=1e-6)


@pytest.mark.parametrize("angle", [0.01, 0.6])
def test_a_term_bends_an_fov_lens_as_a_polynomial(angle: float) -> None:
    lens = pycolmap.Camera(model="FOV", width=100, height=80, params=[90.0, 90.0, 50.0, 40.0, angle])
    bent = with_radial_term(lens, -0.2)
    r = np.linspace(0.01, 0.1, 10)
    rays = np.column_stack([r, np.zeros_like(r)])
    before, after = (c.img_from_cam(np.column_stack([rays, np.ones(len(r))]))[:, 0] - 50.0 for c in (lens, bent))
    # To first order in r^2; the fourth order of the atan is what is left.
    assert np.allclose(after / before, 1.0 - 0.2 * r**2, atol=2.0 * r.max() ** 4)
    assert np.allclose(with_radial_term(pycolmap.Camera(lens.todict()), 5.0).params[4], 0.01, atol=1e-6)
