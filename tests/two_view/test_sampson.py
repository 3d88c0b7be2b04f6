"""Sampson residuals against the essential matrix's formula, and their derivatives by poses and keypoints."""

from dataclasses import replace

import numpy as np
import pytest
from matched_rays import matched_rays

from colmap_vg.geometry.directions import normalized
from colmap_vg.two_view import sampson
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors

FOCALS1, FOCALS2 = np.array([900.0, 800.0, 700.0]), np.array([400.0, 500.0, 600.0])


def matches_of(data, unknowns=0):
    """Matches with no, two or three lens unknowns."""
    m = len(data.rotations)
    variances = FOCALS1[:m] ** -2.0, FOCALS2[:m] ** -2.0
    matches = sampson.Matches.of_rays(data.offsets, data.bearings1, data.bearings2, *variances)
    pieces = matches.pieces
    gains = np.random.default_rng(9).uniform(0.1, 0.5, (len(pieces.columns), 2, pieces.columns.shape[2]))
    return replace(
        matches,
        focal_ratios=np.ones((2, m)) if unknowns else None,
        radial_gains=gains if unknowns == 3 else None,
    )


def test_residuals_are_those_of_the_essential_matrix():
    data = matched_rays(0, [40, 0, 300], sigma=0.01)
    E = essential_from_pose(data.rotations, data.directions)
    expected = sampson_errors(E, data.offsets, data.bearings1, data.bearings2, FOCALS1, FOCALS2)
    found = sampson.residuals(matches_of(data), data.rotations, data.directions)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=1e-9)
    costs = sampson.cauchy_costs(matches_of(data), data.rotations, data.directions, np.array([1.0, 2.0, 3.0]))
    assert costs[1] == 0.0
    assert costs[2] == pytest.approx(9.0 * np.log1p(np.square(expected[40:] / 3.0)).sum())


@pytest.mark.parametrize("unknowns", [0, 2, 3])
def test_normal_equations_are_sums_over_the_derivatives_of_residuals(unknowns):
    data = matched_rays(1, [30, 70, 260], sigma=0.01)
    matches, scales = matches_of(data, unknowns), np.array([1.0, 4.0, 9.0])
    found = sampson.normal_equations(matches, data.rotations, data.directions, scales)
    parts = list(sampson.derivatives_by_block(matches, data.rotations, data.directions))
    r = np.concatenate([part.r for *_, part in parts])
    J = np.concatenate([part.by_pose for *_, part in parts], axis=1)
    assert len(J) == 5 + unknowns
    for k in range(3):
        rows = slice(data.offsets[k], data.offsets[k + 1])
        ratio = np.square(r[rows] / scales[k])
        weighted = J[:, rows] / (1.0 + ratio)
        np.testing.assert_allclose(found.gradients[k], weighted @ r[rows], rtol=1e-8)
        np.testing.assert_allclose(found.hessians[k], weighted @ J[:, rows].T, rtol=1e-8, atol=1e-6)
        slopes = (1.0 - ratio) / np.square(1.0 + ratio)
        assert found.slopes[k] == pytest.approx(slopes.sum() / (1.0 / (1.0 + ratio)).sum())
    some = np.array([2, 0])
    alone = sampson.normal_equations(matches.of(some), data.rotations[some], data.directions[some], scales[some])
    np.testing.assert_allclose(alone.gradients, found.gradients[some], rtol=1e-9)


def test_shrinks_are_those_of_rays_of_longer_focal_lengths():
    data = matched_rays(2, [30, 70, 260], sigma=0.01)
    factors = np.array([[0.9, 1.1, 1.0], [1.2, 0.8, 1.0]])
    edge = np.repeat(np.arange(3), np.diff(data.offsets))
    rays = []
    for side, bearings in enumerate((data.bearings1, data.bearings2)):
        rays.append(normalized(bearings * np.stack([factors[side, edge], factors[side, edge], np.ones(len(edge))], 1)))
    shrunk = sampson.Matches(matches_of(data).pieces, matches_of(data).variances, factors)
    direct = sampson.Matches.of_rays(data.offsets, *rays, FOCALS1**-2.0, FOCALS2**-2.0)
    one, two = (sampson.residuals(m, data.rotations, data.directions) for m in (shrunk, direct))
    np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-10)
    some = sampson.residuals(shrunk.of(np.array([0, 2])), data.rotations[[0, 2]], data.directions[[0, 2]])
    np.testing.assert_allclose(some, one[edge != 1], rtol=1e-12)


def test_derivatives_by_keypoints_are_those_of_finite_differences():
    data = matched_rays(3, [30, 70], sigma=0.002)
    matches = matches_of(data)
    parts = list(sampson.derivatives_by_block(matches, data.rotations, data.directions))
    by_rays = [np.concatenate([getattr(part, name) for *_, part in parts], axis=1) for name in ("by_ray1", "by_ray2")]
    np.testing.assert_allclose(sum(np.square(b).sum(axis=0) for b in by_rays), 1.0, rtol=1e-9)
    edge, rng = np.repeat(np.arange(2), np.diff(data.offsets)), np.random.default_rng(0)
    for side, focals in ((0, FOCALS1), (1, FOCALS2)):
        bearings = [data.bearings1, data.bearings2]
        along = rng.standard_normal(bearings[side].shape)
        along -= np.sum(along * bearings[side], axis=1, keepdims=True) * bearings[side]
        along /= focals[edge, None]  # a pixel long on the average
        ends = []
        for sign in (1.0, -1.0):
            rays = list(bearings)
            rays[side] = normalized(bearings[side] + sign * 1e-4 * along)
            moved = sampson.Matches.of_rays(data.offsets, *rays, FOCALS1[:2] ** -2.0, FOCALS2[:2] ** -2.0)
            ends.append(sampson.residuals(moved, data.rotations, data.directions))
        slopes = (ends[0] - ends[1]) / 2e-4
        expected = np.sum(by_rays[side].T * along * focals[edge, None], axis=1)
        np.testing.assert_allclose(slopes, expected, atol=0.03)


def test_the_same_bits_in_blocks_of_any_size(monkeypatch):
    from colmap_vg.two_view import pieces

    data = matched_rays(4, [30, 700, 260], sigma=0.01)
    costs = []
    for rows in (64, 8192):
        monkeypatch.setattr(pieces, "ROWS_PER_BLOCK", rows)
        costs.append(sampson.cauchy_costs(matches_of(data), data.rotations, data.directions, np.ones(3)))
    np.testing.assert_array_equal(*costs)
