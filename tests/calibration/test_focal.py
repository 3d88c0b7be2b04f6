"""Voted focal lengths: the curves are those of singular values, and the votes find the truth or say they cannot."""

import numpy as np
import pytest
from epipolar_scenes import pixel_scene

from colmap_vg.calibration.focal import focal_agreement, vote_focal_lengths
from colmap_vg.calibration.focal_curves import _NODES, curves_of_each_camera, focal_curves
from colmap_vg.calibration.self_calibration import estimate_focal_lengths
from colmap_vg.errors import GraphError
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances
from colmap_vg.two_view.segments import rows_of_segments


def _evidence(scene):
    F = estimate_fundamental_from_inliers(scene.offsets, scene.points1, scene.points2)
    known = fundamental_covariances(scene.offsets, scene.points1, scene.points2, F)
    return F, scene.camera_idx[scene.edges], scene.principal_points, scene.image_sizes, known.covariances


def _vote(scene, **kwargs):
    F, cameras, principal, sizes, covariances = _evidence(scene)
    return vote_focal_lengths(F, cameras, principal, sizes, covariances=covariances, **kwargs)


def test_curves_are_those_of_singular_values():
    scene = pixel_scene(0, [900.0, 1300.0], num_images=6)
    F, cameras, principal, sizes, covariances = _evidence(scene)
    held = np.log([0.8, 1.1])
    curves = curves_of_each_camera(focal_curves(F, cameras, principal, sizes[:, 0] * 1.0, covariances), held)
    log_f = np.log(np.array([0.5, 1.0, 2.0]))
    found = curves.deviations(np.broadcast_to(log_f, (len(curves.camera), 3)), held)
    for o in range(len(curves.camera)):
        for g, f in enumerate(log_f):
            f1, f2 = np.exp(np.where(curves.cameras[o] == curves.camera[o], f, held[curves.cameras[o]]))
            s = np.linalg.svd(np.diag([f2, f2, 1]) @ curves.F[o] @ np.diag([f1, f1, 1]), compute_uv=False)
            assert found[o, g] == pytest.approx((s[0] - s[1]) / (s[0] + s[1]), abs=1e-6)


def test_standard_deviations_are_those_of_repeated_experiments():
    draws = [pixel_scene(1, [1000.0], num_images=5, num_matches=150, sigma_px=0.0)] * 200
    rng = np.random.default_rng(0)
    scene = draws[0]
    deviations, predicted = [], []
    wrong = np.log(0.7)
    for _ in draws:
        p1, p2 = (p + 0.4 * rng.standard_normal(p.shape) for p in (scene.points1, scene.points2))
        F = estimate_fundamental_from_inliers(scene.offsets, p1, p2, num_iterations=3)
        covariances = fundamental_covariances(scene.offsets, p1, p2, F).covariances
        curves = focal_curves(F, scene.camera_idx[scene.edges], scene.principal_points, np.array([1000.0]), covariances)
        at = np.full((len(F), 1), wrong)
        deviations.append(curves.deviations(at, np.array([wrong]))[:, 0])
        predicted.append([np.exp(np.interp(wrong, _NODES, row)) for row in curves.log_sd])
    measured, predicted = np.std(deviations, axis=0), np.median(predicted, axis=0)
    # Where h is many standard deviations from zero it is normal, with the deviation that was propagated.
    clear = np.mean(deviations, axis=0) > 5 * measured
    assert clear.sum() >= 3
    # h is one of two components; given the other, which the curve conditions on, it spreads a little less.
    np.testing.assert_allclose(predicted[clear], measured[clear], rtol=0.35)


@pytest.mark.parametrize("focal", [450.0, 1100.0, 2600.0])
def test_one_camera_is_found_within_a_percent(focal):
    found = _vote(pixel_scene(2, [focal], num_matches=200))
    assert found.reliable.tolist() == [True]
    assert found.focal_lengths[0] == pytest.approx(focal, rel=0.01)
    assert abs(np.log(found.focal_lengths[0] / focal)) < 5 * found.sigmas[0]


def test_several_cameras_are_told_apart():
    scene = pixel_scene(3, [800.0, 1000.0, 1400.0], num_images=24, num_matches=200, sigma_px=0.3)
    found = _vote(scene)
    np.testing.assert_allclose(found.focal_lengths, scene.focal_lengths, rtol=0.02)
    assert found.reliable.all()


def test_false_and_planar_pairs_have_no_say():
    scene = pixel_scene(4, [1000.0], num_matches=200)
    F, cameras, principal, sizes, covariances = _evidence(scene)
    rng = np.random.default_rng(0)
    false = rng.permutation(len(F))[: len(F) // 4]
    F[false] = rng.permutation(F[false].reshape(-1, 9), axis=1).reshape(-1, 3, 3)
    found = vote_focal_lengths(F, cameras, principal, sizes, covariances=covariances)
    assert found.focal_lengths[0] == pytest.approx(1000.0, rel=0.01)
    planar = _vote(pixel_scene(4, [1000.0], planar=True))
    assert not planar.reliable.any()


def test_order_direction_and_scale_of_pairs_do_not_matter():
    scene = pixel_scene(5, [1000.0, 1200.0], num_images=16)
    F, cameras, principal, sizes, covariances = _evidence(scene)
    first = vote_focal_lengths(F, cameras, principal, sizes, covariances=covariances)
    swap = np.arange(9).reshape(3, 3).T.ravel()
    turned = vote_focal_lengths(
        -7.0 * np.swapaxes(F, 1, 2)[::-1],
        cameras[::-1, ::-1],
        principal,
        sizes,
        covariances=49.0 * covariances[::-1][:, swap][:, :, swap],
    )
    np.testing.assert_allclose(turned.focal_lengths, first.focal_lengths, rtol=1e-6)
    np.testing.assert_array_equal(turned.support, first.support)


def test_given_focals_are_held_against_the_votes():
    F, cameras, principal, sizes, covariances = _evidence(pixel_scene(6, [1000.0], num_matches=200))
    for given, contradicted in ((1000.0, False), (1030.0, False), (850.0, True), (1200.0, True)):
        found = focal_agreement(np.array([given]), F, cameras, principal, sizes, covariances=covariances)
        assert found.contradicted.tolist() == [contradicted]
        assert found.ratios[0] == pytest.approx(given / 1000.0, rel=0.01)


def test_turntables_are_left_to_rotation_cycles():
    scene = pixel_scene(7, [1800.0], turntable=True, num_images=16, num_matches=150)
    assert not _vote(scene).reliable.any()
    found = estimate_focal_lengths(
        scene.edges,
        scene.camera_idx,
        scene.offsets,
        scene.points1,
        scene.points2,
        np.array([1200.0]),
        scene.principal_points,
        scene.image_sizes,
    )
    assert found.by_cycles is not None
    assert found.found.all()
    assert found.focal_lengths[0] == pytest.approx(1800.0, rel=0.04)  # a start for the adjustments


def test_cycles_are_not_asked_for_a_lens_that_pairs_decide():
    scene = pixel_scene(10, [1000.0], num_matches=200)
    of_first = np.flatnonzero((scene.edges == 0).any(axis=1))
    kept = np.setdiff1d(np.arange(len(scene.edges)), of_first[2:])
    rows, offsets = rows_of_segments(scene.offsets, kept)

    def estimated(**options):
        return estimate_focal_lengths(
            scene.edges[kept],
            np.where(np.arange(scene.edges.max() + 1) == 0, 1, 0),
            offsets,
            scene.points1[rows],
            scene.points2[rows],
            np.array([1200.0, 1200.0]),
            np.repeat(scene.principal_points, 2, axis=0),
            np.repeat(scene.image_sizes, 2, axis=0),
            **options,
        )

    apart, alike = estimated(), estimated(lens_groups=np.array([0, 0]))
    assert apart.by_cycles is not None
    assert alike.by_cycles is None
    assert alike.decided.tolist() == [True, False]
    assert alike.focal_lengths[1] == 1200.0


def test_cameras_that_nothing_is_known_of_keep_their_focal():
    scene = pixel_scene(8, [1000.0], planar=True, num_images=6)
    found = estimate_focal_lengths(
        scene.edges,
        np.where(scene.camera_idx == 0, 0, 0),
        scene.offsets,
        scene.points1,
        scene.points2,
        np.array([1000.0, 777.0]),
        np.repeat(scene.principal_points, 2, axis=0),
        np.repeat(scene.image_sizes, 2, axis=0),
    )
    assert not found.decided[1]
    assert found.focal_lengths[1] == 777.0


def test_nothing_to_vote_with_is_an_error():
    scene = pixel_scene(9, [1000.0], num_images=5)
    F, cameras, principal, sizes, _ = _evidence(scene)
    with pytest.raises(GraphError, match="no pair has a fundamental matrix"):
        vote_focal_lengths(np.full_like(F, np.nan), cameras, principal, sizes)
    with pytest.raises(GraphError, match="there are 1 cameras"):
        vote_focal_lengths(F, cameras + 1, principal, sizes)
