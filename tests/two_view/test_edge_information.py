"""Refined relative poses are at the minimum, and their information is what repeated experiments show."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matched_rays import matched_rays
from scipy.optimize import least_squares

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY
from colmap_vg.two_view import sampson
from colmap_vg.two_view.edge_information import refine_relative_poses
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors


def _refine(data, rotations, directions, focal1, focal2, **kwargs):
    return refine_relative_poses(
        data.offsets, data.bearings1, data.bearings2, rotations, directions, focal1, focal2, **kwargs
    )


def _started_off(data, rng, rotation=0.02, direction=0.05):
    return (
        so3.perturbed(data.rotations, rotation, rng),
        normalized(data.directions + direction * rng.standard_normal(data.directions.shape)),
    )


def test_exact_matches_give_exact_poses_and_edges_without_matches_stay():
    data = matched_rays(0, [60, 0, 25])
    focal = np.full(3, 1000.0)
    R, d = _started_off(data, np.random.default_rng(0))
    found = _refine(data, R, d, focal, focal)
    for k in (0, 2):
        np.testing.assert_allclose(found.rotations[k], data.rotations[k], atol=1e-7)
        np.testing.assert_allclose(found.directions[k], data.directions[k], atol=1e-7)
    np.testing.assert_allclose(found.rotations[1], R[1], atol=1e-12)
    assert not found.information[1].any()
    assert np.isnan(found.median_errors_px[1])


def test_minimum_is_the_one_that_scipy_finds():
    data = matched_rays(1, [80], sigma=6e-4, outlier_share=0.1)
    f1, f2 = np.array([900.0]), np.array([500.0])
    found = _refine(data, data.rotations, data.directions, f1, f2, max_num_steps=200)
    scale = EFFICIENT_CAUCHY * found.sigmas_px[0]

    def residuals(x):
        R = so3.exp(x[None, :3]) @ data.rotations
        d = normalized(data.directions + (tangent_basis(data.directions) @ x[3:, None])[..., 0])
        E = essential_from_pose(R, d)
        return sampson_errors(E, data.offsets, data.bearings1, data.bearings2, f1, f2)

    best = least_squares(residuals, np.zeros(5), loss="cauchy", f_scale=scale, xtol=1e-12, ftol=1e-14)
    expected = so3.exp(best.x[None, :3]) @ data.rotations
    # The scale of the last round is that of the round before: the minimum moves by a fraction of a sigma at most.
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information[0])))
    assert np.abs(so3.log(found.rotations @ np.swapaxes(expected, 1, 2))[0] / sigma[:3]).max() < 0.02
    reported = np.median(
        np.abs(
            sampson_errors(
                essential_from_pose(found.rotations, found.directions),
                data.offsets,
                data.bearings1,
                data.bearings2,
                f1,
                f2,
            )
        )
    )
    assert found.median_errors_px[0] == pytest.approx(reported, rel=1e-9)


def test_derivatives_are_those_of_finite_differences():
    data = matched_rays(2, [10, 12], sigma=0.02)
    matches = sampson.Matches.of_rays(
        data.offsets, data.bearings1, data.bearings2, np.array([900.0, 800]) ** -2, np.array([400.0, 500]) ** -2
    )

    def costs(step):
        R, d = sampson.moved(data.rotations, data.directions, step)
        return sampson.cauchy_costs(matches, R, d, np.array([3.0, 5.0]))

    found = sampson.normal_equations(matches, data.rotations, data.directions, np.array([3.0, 5.0]))
    np.testing.assert_allclose(found.costs, costs(np.zeros((2, 5))), rtol=1e-12)
    for a in range(5):
        step = np.zeros((2, 5))
        step[:, a] = 1e-6
        slopes = (costs(step) - costs(-step)) / 2e-6
        np.testing.assert_allclose(slopes, 2.0 * found.gradients[:, a], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(("outlier_share", "bound"), [(0.0, 0.15), (0.05, 0.25)])
def test_information_is_the_inverse_covariance_of_five_hundred_draws(outlier_share, bound):
    draws, matches, focal, sigma_px = 500, 100, 1000.0, 0.7
    truth = matched_rays(3, [matches])
    rng = np.random.default_rng(0)

    def noisy(rays):
        rays = np.tile(rays, (draws, 1))
        noise = sigma_px / focal * rng.standard_normal((len(rays), 2))
        bad = rng.random(len(rays)) < outlier_share
        noise[bad] *= 40
        return normalized(rays + np.einsum("kab,kb->ka", tangent_basis(rays), noise))

    R, d = np.repeat(truth.rotations, draws, axis=0), np.repeat(truth.directions, draws, axis=0)
    focals = np.full(draws, focal)
    found = refine_relative_poses(
        matches * np.arange(draws + 1), noisy(truth.bearings1), noisy(truth.bearings2), R, d, focals, focals
    )
    w = so3.log(R @ np.swapaxes(found.rotations, 1, 2))
    basis = tangent_basis(found.directions)
    tau = np.einsum("kab,ka->kb", basis, d / np.einsum("ka,ka->k", d, found.directions)[:, None])
    errors = np.concatenate([w, tau], axis=1)
    root = np.linalg.cholesky(np.median(found.information, axis=0))
    whitened = np.linalg.eigvalsh(root.T @ np.cov(errors.T) @ root)
    # The covariance of 500 draws is itself uncertain: eigenvalues of five dimensions spread by ±2 sqrt(5 / 500).
    assert abs(whitened.mean() - 1) < bound
    assert whitened.min() > 0.7 - bound
    assert whitened.max() < 1.3 + bound
    normalised = np.einsum("ka,kab,kb->k", errors, found.information, errors)
    assert normalised.mean() == pytest.approx(5.0, rel=bound)
    if not outlier_share:
        assert np.median(found.sigmas_px) == pytest.approx(sigma_px, rel=0.05)


def test_more_matches_and_longer_focals_tell_more():
    data = matched_rays(4, [1000], sigma=5e-4)
    few = matched_rays(4, [1000], sigma=5e-4)
    focal = np.array([1000.0])
    all_of_them = _refine(data, data.rotations, data.directions, focal, focal)
    quarter = refine_relative_poses(
        np.array([0, 250]), few.bearings1[:250], few.bearings2[:250], data.rotations, data.directions, focal, focal
    )
    ratio = np.trace(all_of_them.information[0]) / np.trace(quarter.information[0])
    assert ratio == pytest.approx(4.0, rel=0.35)
    # The noise level is measured, so the unit of the residuals does not matter.
    scaled = _refine(data, data.rotations, data.directions, 2 * focal, 2 * focal)
    np.testing.assert_allclose(scaled.information, all_of_them.information, rtol=1e-4)
    np.testing.assert_allclose(scaled.sigmas_px, 2 * all_of_them.sigmas_px, rtol=1e-5)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_turned_cameras_turn_the_answer(seed):
    data = matched_rays(seed, [40, 70], sigma=5e-4)
    focal = np.full(2, 800.0)
    rng = np.random.default_rng(seed)
    turn1, turn2 = so3.random(2, rng)
    found = _refine(data, data.rotations, data.directions, focal, focal)
    turned = refine_relative_poses(
        data.offsets,
        data.bearings1 @ turn1.T,
        data.bearings2 @ turn2.T,
        turn2 @ data.rotations @ turn1.T,
        data.directions @ turn1.T,
        focal,
        focal,
    )
    np.testing.assert_allclose(turned.rotations, turn2 @ found.rotations @ turn1.T, atol=1e-5)
    np.testing.assert_allclose(turned.directions, found.directions @ turn1.T, atol=1e-5)
    np.testing.assert_allclose(turned.sigmas_px, found.sigmas_px, rtol=1e-3)
