"""Scenes for bundle adjustment: images around a cloud of points, with lenses that are easy to differentiate."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from colmap_vg.bundle.problem import BundleProblem, BundleState

FOCAL = 800.0


@dataclass
class Pinhole:
    """Focal length, principal point and one radial term."""

    free: np.ndarray

    @property
    def focal(self) -> np.ndarray:
        return self.free == 0

    def project(self, parameters: np.ndarray, rays: np.ndarray) -> np.ndarray:
        f, x, y, k = parameters
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
        return f * flat * (1.0 + k * np.sum(flat**2, axis=1, keepdims=True)) + (x, y)


def scene(
    num_images: int = 6,
    num_points: int = 60,
    *,
    free: tuple[int, ...] = (0, 3),
    num_lenses: int = 2,
    sigma_px: float = 0.0,
    seen: float = 0.7,
    seed: int = 0,
) -> tuple[BundleProblem, BundleState]:
    """Images around a cloud of points, with lenses of their own in turn, and keypoints with noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (num_points, 3))
    angles = np.linspace(0.0, 1.8, num_images)
    R = Rotation.from_euler("yx", np.stack([angles, 0.2 * np.sin(7 * angles)], axis=1)).as_matrix()
    centers = -np.einsum("nba,b->na", R, [0.0, 0.1, 4.0]) + 0.1 * rng.normal(size=(num_images, 3))
    camera_idx = np.sort(np.arange(num_images) % num_lenses)
    lenses = [Pinhole(np.array(free, dtype=np.int64)) for _ in range(num_lenses)]
    parameters = [np.array([FOCAL + 30 * c, 500.0, 400.0, -0.05 + 0.02 * c]) for c in range(num_lenses)]
    rows = np.argwhere(rng.random((num_images, num_points)) < seen)
    image_row, point_row = rows[:, 0], rows[:, 1]
    local = np.einsum("kab,kb->ka", R[image_row], points[point_row] - centers[image_row])
    keypoints = np.zeros((len(rows), 2))
    for c, lens in enumerate(lenses):
        own = camera_idx[image_row] == c
        keypoints[own] = lens.project(parameters[c], local[own])
    keypoints += sigma_px * rng.normal(size=keypoints.shape)
    problem = BundleProblem(image_row, point_row, keypoints, camera_idx, lenses)
    return problem, BundleState(R, centers, points, parameters)


def street(num_images: int, *, sigma_px: float = 0.3, seed: int = 0) -> tuple[BundleProblem, BundleState]:
    """Images along a façade, each of which sees what is within two steps of it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.0, -1.0, 3.0], [num_images + 1.0, 1.0, 4.0], (8 * num_images, 3))
    centers = np.stack([np.arange(num_images), *np.zeros((2, num_images))], axis=1).astype(np.float64)
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    image_row, point_row = np.nonzero(np.abs(points[:, 0] - centers[:, :1]) < 2.0)
    lens = Pinhole(np.zeros(0, dtype=np.int64))
    parameters = np.array([FOCAL, 500.0, 400.0, 0.0])
    keypoints = lens.project(parameters, points[point_row] - centers[image_row])
    keypoints += sigma_px * rng.normal(size=keypoints.shape)
    problem = BundleProblem(image_row, point_row, keypoints, np.zeros(num_images, dtype=np.int64), [lens])
    return problem, BundleState(rotations, centers, points, [parameters])


def bent(state: BundleState, angle: float) -> BundleState:
    """A street bent to an arc, whose ends point an angle, radians, from its middle; what images see stays nearly."""
    length = float(np.ptp(state.centers[:, 0])) / 2.0
    middle = float(state.centers[:, 0].mean())

    def moved(positions: np.ndarray) -> np.ndarray:
        turn = angle * (positions[:, 0] - middle) / length
        radius = length / angle
        depth = radius - positions[:, 2]
        return np.stack([middle + depth * np.sin(turn), positions[:, 1], radius - depth * np.cos(turn)], axis=1)

    turns = angle * (state.centers[:, 0] - middle) / length
    R = Rotation.from_euler("y", turns[:, None]).as_matrix()
    return BundleState(R, moved(state.centers), moved(state.points), state.parameters)


def displaced(problem: BundleProblem, state: BundleState, size: float, seed: int = 1) -> BundleState:
    """A state some way off, with focal lengths and radial terms too."""
    rng = np.random.default_rng(seed)
    n = problem.num_images
    step = size * rng.normal(size=problem.num_unknowns)
    for lens in problem.lenses:
        assert len(lens.free) in (0, 2)
    step[6 * n :: 2] *= FOCAL
    points = state.points + size * rng.normal(size=state.points.shape)
    return state.moved(problem, step, points, state.viewed(problem))


def plain_residuals(problem: BundleProblem, state: BundleState) -> np.ndarray:
    found = np.zeros((len(problem.image_row), 2))
    for k, (image, point) in enumerate(zip(problem.image_row, problem.point_row, strict=True)):
        camera = problem.camera_idx[image]
        local = state.rotations[image] @ (state.points[point] - state.centers[image])
        found[k] = problem.lenses[camera].project(state.parameters[camera], local[None])[0] - problem.keypoints[k]
    return found.ravel()
