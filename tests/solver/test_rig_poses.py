"""Poses of frames and sensors from those of images, some of which are wrong, and links between components."""

import numpy as np
import pytest

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.scene.rigs import Rigs
from colmap_vg.solver.rig_links import link_components
from colmap_vg.solver.rig_poses import average_rig_poses

NUM_FRAMES, NUM_SENSORS, SCALE = 12, 3, 0.3


class Scene:
    """True poses of a rig's frames, sensors and images; images have the frames' unit times `SCALE`."""

    def __init__(self, known: bool, seed: int = 0, baseline: float = 0.5) -> None:
        rng = np.random.default_rng(seed)
        self.S, self.c = so3.random(NUM_SENSORS, rng), baseline * rng.normal(size=(NUM_SENSORS, 3))
        self.S[0], self.c[0] = np.eye(3), 0.0
        self.F, self.C = so3.random(NUM_FRAMES, rng), 3.0 * rng.normal(size=(NUM_FRAMES, 3))
        frame, sensor = np.repeat(np.arange(NUM_FRAMES), NUM_SENSORS), np.tile(np.arange(NUM_SENSORS), NUM_FRAMES)
        self.R = self.S[sensor] @ self.F[frame]
        self.P = SCALE * (self.C[frame] + np.einsum("kba,kb->ka", self.F[frame], self.c[sensor]))
        rotations, translations = self.S.copy(), -np.einsum("kab,kb->ka", self.S, self.c)
        if not known:
            rotations[1:], translations[1:] = np.nan, np.nan
        ids = np.arange(NUM_SENSORS)
        self.rigs = Rigs(
            frame, sensor, np.arange(NUM_FRAMES), np.zeros_like(ids), ids, rotations, translations, ids == 0
        )
        self.all = np.ones(len(frame), dtype=bool)


@pytest.mark.parametrize("known", [True, False])
def test_exact_poses_are_recovered(known: bool) -> None:
    scene = Scene(known)
    found = average_rig_poses(scene.rigs, scene.all, scene.R, scene.P)
    np.testing.assert_allclose(found.frame_rotations, scene.F, atol=1e-6)
    np.testing.assert_allclose(found.frame_centers, SCALE * scene.C, atol=1e-6)
    np.testing.assert_allclose(found.sensor_rotations, scene.S, atol=1e-6)
    np.testing.assert_allclose(found.sensor_centers, SCALE * scene.c, atol=1e-6)
    assert found.scale == pytest.approx(1.0 / SCALE if known else 1.0, rel=1e-6)
    assert found.scale_is_certain == known
    assert found.posed_frames.all()
    assert found.posed_sensors.all()


@pytest.mark.parametrize("known", [True, False])
def test_a_wrong_image_in_every_other_frame_does_no_harm(known: bool) -> None:
    scene, rng = Scene(known), np.random.default_rng(1)
    wrong = np.arange(0, len(scene.R), 2 * NUM_SENSORS) + rng.integers(NUM_SENSORS, size=NUM_FRAMES // 2)
    R, P = so3.perturbed(scene.R, 1e-3, rng), scene.P + 1e-3 * rng.normal(size=scene.P.shape)
    R[wrong], P[wrong] = so3.random(len(wrong), rng), rng.normal(size=(len(wrong), 3))
    found = average_rig_poses(scene.rigs, scene.all, R, P)
    assert np.degrees(so3.angle(np.swapaxes(found.frame_rotations, 1, 2) @ scene.F)).max() < 0.5
    assert np.linalg.norm(found.frame_centers / SCALE - scene.C, axis=1).max() < 0.02
    assert np.linalg.norm(found.sensor_centers / SCALE - scene.c, axis=1).max() < 0.02


def test_frames_and_sensors_without_images_have_no_pose() -> None:
    scene = Scene(known=False)
    solved = (scene.rigs.sensor_idx != 2) & (scene.rigs.frame_idx != 5)
    R, P = np.where(solved[:, None, None], scene.R, np.nan), np.where(solved[:, None], scene.P, np.nan)
    found = average_rig_poses(scene.rigs, solved, R, P)
    assert np.flatnonzero(~found.posed_frames).tolist() == [5]
    assert np.flatnonzero(~found.posed_sensors).tolist() == [2]
    np.testing.assert_allclose(found.frame_centers[:5], SCALE * scene.C[:5], atol=1e-6)


def test_a_chain_of_sensors_reaches_all() -> None:
    """Frames with sensors 0 and 1, and others with 1 and 2: the place of 2 follows."""
    scene = Scene(known=False)
    early = scene.rigs.frame_idx < NUM_FRAMES // 2
    solved = np.where(early, scene.rigs.sensor_idx <= 1, scene.rigs.sensor_idx >= 1)
    found = average_rig_poses(scene.rigs, solved, scene.R, scene.P)
    assert found.posed_frames.all()
    np.testing.assert_allclose(found.sensor_centers, SCALE * scene.c, atol=1e-6)


def test_baselines_below_the_noise_do_not_tell_the_scale() -> None:
    scene = Scene(known=True, baseline=1e-3)
    P = scene.P + 0.02 * np.random.default_rng(0).normal(size=scene.P.shape)
    found = average_rig_poses(scene.rigs, scene.all, scene.R, P)
    assert not found.scale_is_certain
    assert np.isfinite(found.scale)
    assert found.scale > 0


def moved(scene: Scene, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The scene's poses, those of some images in another frame and unit."""
    W, shift = so3.random(1, np.random.default_rng(7))[0], np.array([3.0, -2.0, 5.0])
    R, P = scene.R.copy(), scene.P.copy()
    R[rows], P[rows] = R[rows] @ W.T, 2.5 * P[rows] @ W.T + shift
    return R, P


def test_components_of_different_cameras_are_linked_by_their_frames() -> None:
    scene = Scene(known=True)
    other = scene.rigs.sensor_idx == 2
    R, P = moved(scene, other)
    component = link_components(scene.rigs, R, P, other.astype(np.int64))
    assert (component == 0).all()
    np.testing.assert_allclose(R, scene.R, atol=1e-6)
    np.testing.assert_allclose(P, scene.P, atol=1e-6)


def test_what_does_not_agree_or_is_not_known_is_not_linked() -> None:
    for known, spoilt in ((True, True), (False, False)):
        scene = Scene(known)
        other = scene.rigs.sensor_idx == 2
        R, P = moved(scene, other)
        if spoilt:
            R[other] = so3.random(int(other.sum()), np.random.default_rng(0))
        before = R.copy(), P.copy()
        component = link_components(scene.rigs, R, P, other.astype(np.int64))
        np.testing.assert_array_equal(component, other.astype(np.int64))
        np.testing.assert_array_equal(R, before[0])
        np.testing.assert_array_equal(P, before[1])


def test_frames_of_which_most_disagree_link_nothing() -> None:
    scene = Scene(known=True)
    other = scene.rigs.sensor_idx == 2
    R, P = moved(scene, other)
    wrong = other & (scene.rigs.frame_idx >= 5)  # five of twelve frames agree
    R[wrong], P[wrong] = so3.random(int(wrong.sum()), np.random.default_rng(0)), 0.0
    component = link_components(scene.rigs, R, P, other.astype(np.int64))
    np.testing.assert_array_equal(component, other.astype(np.int64))


def test_two_common_frames_are_too_few() -> None:
    scene = Scene(known=True)
    other = scene.rigs.sensor_idx == 2
    R, P = moved(scene, other)
    component = np.where(other, 1, np.where(scene.rigs.frame_idx < 2, 0, -1))
    assert set(link_components(scene.rigs, R, P, component)) == {-1, 0, 1}


def test_wrong_arrays_are_refused() -> None:
    rigs = Scene(known=True).rigs
    with pytest.raises(GraphError, match=r"sensor_idx has rows 0 to 2, outside 0 to 1"):
        Rigs(
            rigs.frame_idx,
            rigs.sensor_idx,
            rigs.frame_ids,
            rigs.rig_ids[:2],
            rigs.camera_ids[:2],
            rigs.rotations[:2],
            rigs.translations[:2],
            rigs.reference[:2],
        )
    with pytest.raises(GraphError, match=r"rotations has shape \(3, 3\)"):
        Rigs(
            rigs.frame_idx,
            rigs.sensor_idx,
            rigs.frame_ids,
            rigs.rig_ids,
            rigs.camera_ids,
            rigs.translations,
            rigs.translations,
            rigs.reference,
        )
