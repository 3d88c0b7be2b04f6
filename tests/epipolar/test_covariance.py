"""Covariances of adjusted cameras: honest over image sets whose pairs share keypoints, and those of many draws."""

from dataclasses import replace

import numpy as np
import pytest
from image_sets import image_set

from colmap_vg.epipolar.adjustment import adjust_epipolar, cost_and_gradient
from colmap_vg.epipolar.cameras import Cameras
from colmap_vg.epipolar.covariance import _without_gauge, camera_covariances
from colmap_vg.epipolar.problem import Lenses
from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import align_positions

LAYOUTS = ("ring", "street", "grid")


def adjusted(problem, R, p):
    return adjust_epipolar(problem, R, p, Cameras(R, p, Lenses(np.zeros(1))).relative(problem.edges)[1])


def normalized_errors(problem, R, p):
    """Mean normalised squared errors of positions and rotations; 1 is expected of each."""
    found = adjusted(problem, R, p)
    known = camera_covariances(problem, found)
    _, similarity = align_positions(found.projection_centers, p)
    x = similarity.scale * found.projection_centers @ similarity.rotation.T + similarity.translation - p
    C = similarity.scale**2 * similarity.rotation @ known.positions @ similarity.rotation.T
    w = so3.log(found.cam_from_world_rotations @ similarity.rotation.T @ np.swapaxes(R, 1, 2))
    squares = [np.einsum("na,nab,nb->n", e, np.linalg.inv(c), e) for e, c in ((x, C), (w, known.rotations))]
    return np.mean(squares, axis=1) / 3.0


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "free"), [(0.0, False), (0.1, False), (0.0, True)])
def test_errors_are_as_large_as_the_covariances_say(wrong, free):
    errors = []
    for seed in range(24):
        rng = np.random.default_rng(1000 + seed)
        n, sigma_px, num_points = int(rng.integers(10, 21)), float(rng.uniform(0.3, 1.5)), int(rng.integers(150, 400))
        errors.append(normalized_errors(*image_set(seed, LAYOUTS[seed % 3], n, num_points, sigma_px, wrong, free)))
    positions, rotations = np.mean(errors, axis=0)
    assert 0.8 < positions < 1.25
    assert 0.75 < rotations < 1.3


def with_term(problem):
    """The problem with a radial term of 0 among the unknowns."""
    return replace(problem, free_focals=np.array([True]), bent_cameras=np.array([True]))


def inverse_hessian(problem, at):
    """Covariances of positions and rotations (n, 3, 3) under independent unit noise of the residuals."""
    free, n = np.flatnonzero(problem.free_focals), problem.num_images
    size = 6 * n + len(free) + (problem.bent_cameras is not None)
    ends = [
        np.stack([cost_and_gradient(problem, at.moved(step, free), 1e6)[1] for step in sign * 1e-5 * np.eye(size)])
        for sign in (1.0, -1.0)
    ]
    H = (ends[0] - ends[1]) / 2e-5
    values, axes = np.linalg.eigh(0.5 * (H + H.T))
    steps = (axes[:, 7:] / np.sqrt(values[7:]))[: 6 * n]  # the gauge has the seven least
    turns, shifts = _without_gauge(at, steps.reshape(n, 6, -1))
    return np.einsum("nad,nbd->nab", shifts, shifts), np.einsum("nad,nbd->nab", turns, turns)


def test_an_unknown_radial_term_makes_cameras_as_uncertain_as_the_inverse_hessian_says():
    problem, R, p = image_set(0, "street", 12, 400, 0.02)
    problem = replace(problem, keypoints1=None, keypoints2=None, triplets=None, free_focals=np.array([True]))
    found = replace(adjusted(problem, R, p), scale_px=1e6)
    problems = problem, with_term(problem)
    drawn = [camera_covariances(one, found, num_draws=256) for one in problems]
    exact = [inverse_hessian(one, found.cameras) for one in problems]
    for kind, most, error in ((0, 1.08, 0.03), (1, 2.5, 0.1)):
        known, expected = (
            np.divide(*(np.trace(pair[kind], axis1=1, axis2=2) for pair in (with_it, without)))
            for without, with_it in ([(one.positions, one.rotations) for one in drawn], exact)
        )
        assert expected.max() > most
        np.testing.assert_allclose(known, expected, rtol=error)  # of 256 draws, the same of both


def test_each_unknown_of_the_lens_takes_up_a_residual():
    problem, R, p = image_set(8, "grid", 12, 200, 0.7)
    found = adjusted(problem, R, p)
    held, focal, both = (
        camera_covariances(one, found, num_draws=1).sigma_px
        for one in (problem, replace(problem, free_focals=np.array([True])), with_term(problem))
    )
    # A standard deviation over the root of the degrees of freedom, of which each unknown takes one.
    assert held < focal < both
    assert held**-2 - focal**-2 == pytest.approx(focal**-2 - both**-2, rel=1e-6)


@pytest.mark.slow
def test_covariances_are_those_of_many_draws_of_one_scene():
    # The same cameras, points and visibility, with other noise each time.
    exact, R, p = image_set(3, "ring", 10, 150, 0.0)
    drawn_px, draws = 0.8, 60
    rng = np.random.default_rng(7)
    centers = []
    rays = {}
    for side, keypoints in ((0, exact.keypoints1), (1, exact.keypoints2)):
        image = np.repeat(exact.edges[:, side], np.diff(exact.offsets))
        rays[side] = image * 10_000 + keypoints
    triplets = exact.triplets
    of_triplets = np.repeat(triplets.images, np.diff(triplets.offsets), axis=0).T * 10_000 + triplets.keypoints
    for _ in range(draws):
        noise = drawn_px / 1000.0 * rng.standard_normal((10 * 10_000, 3))

        def shaken(x, key, noise=noise):
            moved = x + noise[key]
            return moved / np.linalg.norm(moved, axis=-1, keepdims=True)

        turned = np.swapaxes(shaken(np.moveaxis(triplets.bearings, 1, 2), of_triplets), 1, 2)
        problem = replace(
            exact,
            bearings1=shaken(exact.bearings1, rays[0]),
            bearings2=shaken(exact.bearings2, rays[1]),
            triplets=replace(triplets, bearings=turned),
        )
        found = adjusted(problem, R, p)
        _, similarity = align_positions(found.projection_centers, p)
        centers.append(similarity.scale * found.projection_centers @ similarity.rotation.T + similarity.translation)
    spread = np.trace(np.einsum("dna,dnb->nab", np.array(centers) - p, np.array(centers) - p) / draws, axis1=1, axis2=2)
    known = camera_covariances(problem, found, num_draws=256)
    assert known.sigma_px == pytest.approx(drawn_px, rel=0.1)
    predicted = np.trace(known.positions, axis1=1, axis2=2)
    assert 0.75 < np.sum(predicted) / np.sum(spread) < 1.3
    assert np.corrcoef(np.log(predicted), np.log(spread))[0, 1] > 0.7


def test_shared_keypoints_make_cameras_less_certain():
    problem, R, p = image_set(5, "ring", 14, 200, 0.7)
    found = adjusted(problem, R, p)
    shared = camera_covariances(problem, found).positions
    alone = camera_covariances(replace(problem, keypoints1=None, keypoints2=None, triplets=None), found).positions
    ratio = np.trace(shared, axis1=1, axis2=2) / np.trace(alone, axis1=1, axis2=2)
    assert np.median(ratio) > 1.5


def test_the_gauge_is_out_and_seeds_repeat():
    problem, R, p = image_set(6, "grid", 12, 200, 0.7)
    found = adjusted(problem, R, p)
    first, again = camera_covariances(problem, found, seed=3), camera_covariances(problem, found, seed=3)
    np.testing.assert_array_equal(first.positions, again.positions)
    assert (np.linalg.eigvalsh(first.positions) > 0).all()
    assert (np.linalg.eigvalsh(first.rotations) > 0).all()
    # A world turned round turns the covariances with it.
    turn = so3.exp(np.array([[0.3, -0.7, 1.1]]))[0]
    moved = replace(
        found,
        cam_from_world_rotations=found.cam_from_world_rotations @ turn.T,
        projection_centers=found.projection_centers @ turn.T,
    )
    other = camera_covariances(problem, moved, seed=3)
    np.testing.assert_allclose(other.positions, turn @ first.positions @ turn.T, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(other.rotations, first.rotations, rtol=1e-3, atol=1e-12)
