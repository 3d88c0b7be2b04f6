"""Depth agreement of triplets: exact tracks, unit noise, derivatives, an independent residual."""

import numpy as np
import pytest

from colmap_vg.epipolar.depth_agreement import (
    TripletPoses,
    TripletRays,
    depth_costs,
    depth_equations,
    depth_residuals,
)
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.two_view.pieces import Pieces

FOCALS = np.array([900.0, 1000.0, 1150.0])


class Scene:
    """Three triplets (a, b, c), one of them on a line, that see their own points; frames of b."""

    def __init__(self, seed, *, num_tracks=30, sigma_px=0.0):
        rng = np.random.default_rng(seed)
        self.offsets = num_tracks * np.arange(4)
        self.triplet = np.repeat(np.arange(3), num_tracks)
        self.rotations = so3.exp(0.2 * rng.standard_normal((2, 3, 3)))  # to b
        self.baselines = rng.standard_normal((2, 3, 3))
        self.baselines[1, 0] = -1.7 * self.baselines[0, 0]
        points = rng.uniform([-2, -2, 4], [2, 2, 9], (3 * num_tracks, 3))
        local = [
            np.einsum("kba,kb->ka", self.rotations[0, self.triplet], points + self.baselines[0, self.triplet]),
            points,
            np.einsum("kba,kb->ka", self.rotations[1, self.triplet], points + self.baselines[1, self.triplet]),
        ]
        self.bearings = np.stack(
            [self.noisy(normalized(x), sigma_px / f, rng) for x, f in zip(local, FOCALS, strict=True)]
        )

    @staticmethod
    def noisy(x, sigma, rng):
        return normalized(x + sigma * np.einsum("kab,kb->ka", tangent_basis(x), rng.standard_normal((len(x), 2))))

    def rays(self, log_focals=(0.0, 0.0, 0.0), *, free=False):
        grown = np.exp(np.asarray(log_focals))
        bearings = normalized(self.bearings / np.stack([grown, grown, np.ones(3)], axis=1)[:, None])
        columns = list(bearings.transpose(0, 2, 1).reshape(9, -1))
        ratios = np.ones((3, 3)) if free else None
        return TripletRays(Pieces.cut(self.offsets, columns), np.tile((FOCALS * grown)[:, None] ** -2.0, 3), ratios)

    def poses(self, step=None):
        step = np.zeros(12) if step is None else step
        turns = so3.exp(np.stack([step[:3], step[3:6]]))[:, None] @ self.rotations
        return TripletPoses(turns, self.baselines + np.stack([step[6:9], step[9:12]])[:, None])


def test_exact_tracks_agree():
    scene = Scene(0)
    assert np.abs(depth_residuals(scene.rays(), scene.poses())).max() < 1e-9


@pytest.mark.parametrize("sigma_px", [0.1, 1.0])
def test_noise_of_rays_is_noise_of_residuals(sigma_px):
    scene = Scene(1, num_tracks=3000, sigma_px=sigma_px)
    r = depth_residuals(scene.rays(), scene.poses())
    # 9,000 residuals: their standard deviation is known to 0.75 %.
    assert np.std(r) == pytest.approx(sigma_px, rel=0.04)
    assert abs(np.mean(r)) < 0.04 * sigma_px


def test_residual_is_the_inverse_depth_difference_over_its_numerical_deviation():
    scene = Scene(2, num_tracks=4, sigma_px=1.0)
    poses, rays = scene.poses(), scene.rays()
    r = depth_residuals(rays, poses)

    def difference(x, q):
        """Inverse depths by least squares in ``t - X u_b``, image by image, without the formulas of the module."""
        values = []
        for side, s in ((0, 0), (1, 2)):
            u = poses.rotations[side, q] @ x[s]
            # rho (u x t) = u_b x u
            values.append(np.linalg.lstsq(np.cross(u, poses.baselines[side, q])[:, None], np.cross(x[1], u))[0][0])
        return values[0] - values[1]

    for k, q in enumerate(scene.triplet):
        x, variance = scene.bearings[:, k], 0.0
        for s in range(3):
            for axis in tangent_basis(x[s][None])[0].T:
                ahead, behind = x.copy(), x.copy()
                ahead[s], behind[s] = normalized(x[s] + 1e-6 * axis), normalized(x[s] - 1e-6 * axis)
                variance += ((difference(ahead, q) - difference(behind, q)) / 2e-6 / FOCALS[s]) ** 2
        assert r[k] == pytest.approx(difference(x, q) / np.sqrt(variance), rel=1e-6)


@pytest.mark.parametrize("unknown", range(15))
def test_derivatives_are_those_of_finite_differences(unknown):
    scene = Scene(3, sigma_px=3.0)
    step = np.zeros(15)
    step[unknown] = 1e-6
    at = depth_equations(scene.rays(free=True), scene.poses(), 2.0)
    ahead, behind = (depth_costs(scene.rays(sign * step[12:]), scene.poses(sign * step[:12]), 2.0) for sign in (1, -1))
    np.testing.assert_allclose(at.costs, depth_costs(scene.rays(), scene.poses(), 2.0), rtol=1e-12)
    np.testing.assert_allclose(
        (ahead - behind) / 4e-6, at.gradients[:, unknown], rtol=1e-5, atol=1e-7 * np.abs(at.gradients).max()
    )
    r_ahead, r_behind = (
        depth_residuals(scene.rays(sign * step[12:]), scene.poses(sign * step[:12])) for sign in (1, -1)
    )
    r = depth_residuals(scene.rays(), scene.poses())
    squares = np.square((r_ahead - r_behind) / 2e-6) / (1 + np.square(r / 2.0))
    expected = np.bincount(scene.triplet, weights=squares)
    np.testing.assert_allclose(at.hessians[:, unknown, unknown], expected, rtol=1e-5)
    np.testing.assert_array_equal(at.hessians, np.swapaxes(at.hessians, 1, 2))


def test_equations_without_focals_are_a_part_of_those_with_them():
    scene = Scene(4, sigma_px=1.0)
    few, all_of_them = (depth_equations(scene.rays(free=w), scene.poses(), 1.0) for w in (False, True))
    np.testing.assert_allclose(few.gradients, all_of_them.gradients[:, :12], rtol=1e-12)
    np.testing.assert_allclose(few.hessians, all_of_them.hessians[:, :12, :12], rtol=1e-12, atol=1e-12)


def test_common_scale_changes_nothing():
    scene = Scene(5, sigma_px=1.0)
    scaled = TripletPoses(scene.rotations, 7.0 * scene.baselines)
    np.testing.assert_allclose(depth_residuals(scene.rays(), scaled), depth_residuals(scene.rays(), scene.poses()))


def test_points_on_a_baseline_say_nothing():
    scene = Scene(6)
    scene.bearings[1, 0] = scene.bearings[0, 0] = normalized(scene.baselines[0, 0])
    poses = TripletPoses(np.tile(np.eye(3), (2, 3, 1, 1)), scene.baselines)
    at = depth_equations(scene.rays(free=True), poses, 1.0)
    assert np.isfinite(at.gradients).all()
    assert np.isfinite(at.hessians).all()
    assert abs(depth_residuals(scene.rays(), poses)[0]) < 1e-2
