"""Steps of cameras: equal to plain ones to first order, straight in relative poses, and no image jumps."""

import numpy as np
import pytest
from image_sets import image_set

from colmap_vg.epipolar.cameras import Cameras, CameraSteps, gauged
from colmap_vg.epipolar.problem import Lenses
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3

NONE = np.zeros(0, dtype=int)


def street(num_images: int) -> tuple[Cameras, np.ndarray]:
    """Cameras in a line that look sideways, each linked to the next two."""
    centers = np.stack([np.arange(num_images), np.zeros(num_images), np.zeros(num_images)], axis=1).astype(float)
    first = np.arange(num_images - 2)
    edges = np.concatenate([np.stack([first, first + gap], axis=1) for gap in (1, 2)])
    return Cameras(np.tile(np.eye(3), (num_images, 1, 1)), gauged(centers), Lenses(np.zeros(1))), edges


def bend(cameras: Cameras, angle: float) -> np.ndarray:
    """A step that bends a street into an arc of an angle: turns about y, and shifts along z to first order."""
    n = len(cameras.centers)
    place = cameras.centers[:, 0]
    turn = angle * (place - place[0]) / (place[-1] - place[0])
    step = np.zeros((n, 6))
    step[:, 1] = -turn
    step[1:, 5] = -np.cumsum(0.5 * (turn[1:] + turn[:-1]) * np.diff(place))
    return step


def relative(cameras: Cameras, edges: np.ndarray) -> np.ndarray:
    """Baselines in the frames of both ends, (2, m, 3)."""
    along = cameras.centers[edges[:, 1]] - cameras.centers[edges[:, 0]]
    return np.stack([np.einsum("kab,kb->ka", cameras.rotations[end], along) for end in edges.T])


def test_steps_are_plain_ones_to_first_order() -> None:
    problem, R, p = image_set(0, "ring", 12, 300, 0.5)
    cameras = Cameras(R, gauged(p), Lenses(np.zeros(1)))
    steps, rng = CameraSteps(cameras, problem.edges), np.random.default_rng(0)
    step = np.concatenate([rng.standard_normal(12 * 6), [0.5]])
    free = np.array([0])
    far = []
    for size in (1e-3, 1e-4):
        taken, plain = steps.taken(cameras, size * step, free), cameras.moved(size * step, free)
        np.testing.assert_array_equal(taken.rotations, plain.rotations)
        assert taken.lenses == plain.lenses or taken.lenses.log_scales[0] == plain.lenses.log_scales[0]
        far.append(np.abs(taken.centers - plain.centers).max())
    assert far[1] < 1.1e-2 * far[0] < 1e-5


def test_a_street_that_bends_keeps_its_relative_poses_straight() -> None:
    cameras, edges = street(60)
    step = bend(cameras, 0.9)
    found, plain = CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE), cameras.moved(step.ravel(), NONE)
    np.testing.assert_allclose(so3.log(found.rotations)[:, 1], step[:, 1], atol=1e-12)
    length = np.linalg.norm(found.centers[1:] - found.centers[:-1], axis=1)
    np.testing.assert_allclose(length / length[0], 1.0, atol=1e-3)
    along = relative(found, edges) / length[0]
    bent = relative(plain, edges) / np.linalg.norm(plain.centers[1] - plain.centers[0])
    gap = (edges[:, 1] - edges[:, 0]).astype(float)
    assert np.abs(along[..., 0] - gap).max() < 1e-3
    assert np.abs(bent[..., 0] - gap).max() > 0.1


def test_no_image_jumps_past_its_neighbours_in_one_step() -> None:
    cameras, edges = street(9)
    step = np.zeros((9, 6))
    step[2, 3:], step[5, :3] = [100.0, 0.0, 0.0], [0.0, 3.0, 0.0]
    moved = CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE)
    # Half of the distance to the farther neighbour, which it passes last; the gauge scales all.
    gap = cameras.centers[1, 0] - cameras.centers[0, 0]
    assert moved.centers[2, 0] - cameras.centers[2, 0] < 1.2 * gap
    assert (np.abs(np.delete(moved.centers - cameras.centers, 2, axis=0)) < 0.3 * gap).all()
    assert so3.angle(moved.rotations[5]) == pytest.approx(0.2)
    np.testing.assert_array_equal(np.delete(moved.rotations, 5, axis=0), np.tile(np.eye(3), (8, 1, 1)))


def test_what_moves_together_may_move_far() -> None:
    cameras, edges = street(9)
    step = np.zeros((9, 6))
    step[:, 4] = 5.0 * np.arange(9) * (cameras.centers[1, 0] - cameras.centers[0, 0]) / 12.0
    plain, taken = cameras.moved(step.ravel(), NONE), CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE)
    np.testing.assert_allclose(taken.centers, plain.centers, atol=1e-12)


def test_parts_that_nothing_links_move_as_the_step_says() -> None:
    cameras, edges = street(10)
    edges = edges[(edges < 5).all(axis=1) | (edges >= 5).all(axis=1)]
    step = np.zeros((10, 6))
    step[:5, 3:], step[5:, 3:] = [0.0, 0.05, 0.0], [0.02, 0.0, 0.03]
    taken, plain = CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE), cameras.moved(step.ravel(), NONE)
    np.testing.assert_allclose(taken.centers, plain.centers, atol=1e-9)


def test_cameras_at_one_place_are_refused() -> None:
    with pytest.raises(GraphError, match="coincide"):
        gauged(np.ones((4, 3)))


def test_the_last_image_does_not_jump_either_and_no_image_turns_beyond_a_radian() -> None:
    cameras, edges = street(9)
    step = np.zeros((9, 6))
    step[8, 3:] = [0.0, 100.0, 0.0]
    moved = CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE)
    assert np.abs(moved.centers - cameras.centers).max() < 1.2 * (cameras.centers[1, 0] - cameras.centers[0, 0])
    step = np.zeros((9, 6))  # a turn of the whole street about its first image
    step[:, 1], step[:, 5] = -3.0, -3.0 * (cameras.centers[:, 0] - cameras.centers[0, 0])
    moved = CameraSteps(cameras, edges).taken(cameras, step.ravel(), NONE)
    np.testing.assert_allclose(so3.angle(moved.rotations), 1.0)
