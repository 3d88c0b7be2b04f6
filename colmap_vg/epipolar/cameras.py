"""Cameras of the epipolar adjustment, and the steps that they take.

The matches tell the relative poses of linked images. A step ``R <- exp(w) R, p <- p + x`` of all images at once, as one
that bends a long street or opens a ring, changes relative poses by terms of second order that grow with the turns of
single images, though their neighbours turn with them; so only short steps would lower the cost. :class:`CameraSteps`
takes steps along which relative poses are nearly linear instead: with the new rotations, positions are those that fit
best to the baselines that the step gives each image in its own frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.depth_agreement import TripletPoses
from colmap_vg.epipolar.problem import Lenses
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.laplacian import LaplacianSystem

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SHORTEST_BASELINE = 1e-6
"""Share of the RMS distance of cameras; keeps directions of coinciding cameras finite."""
_MAX_TURN, _MAX_SHIFT = 0.2, 0.5
"""Maximum turn and shift of an image in one step, relative to the neighbour with which it agrees best: radians, and a
share of the distance between them at first, or of a tenth of the median distance."""
_MAX_WHOLE_TURN = 1.0  # radians per step, of any image
_MAX_LOG_FOCAL_STEP = 0.3  # change of a log focal length per step
_MAX_RADIAL_STEP = 0.1  # change of the radial term per step


@dataclass(frozen=True, eq=False)
class Cameras:
    """cam_from_world rotations (n, 3, 3), centres (n, 3) and lenses."""

    rotations: Array
    centers: Array
    lenses: Lenses

    def moved(self, step: Array, free: IntArray) -> "Cameras":
        """Cameras after a step (6 n + f,), w and x of each image, then the free log focals; with the gauge restored.

        A last unknown, if there is one, is the radial term.
        """
        n = len(self.centers)
        poses = step[: 6 * n].reshape(n, 6)
        log_scales, (by_focal, by_term) = self.lenses.log_scales.copy(), np.split(step[6 * n :], [len(free)])
        log_scales[free] += np.clip(by_focal, -_MAX_LOG_FOCAL_STEP, _MAX_LOG_FOCAL_STEP)
        term = self.lenses.radial_term + float(np.clip(by_term, -_MAX_RADIAL_STEP, _MAX_RADIAL_STEP).sum())
        moved = so3.exp(poses[:, :3]) @ self.rotations, gauged(self.centers + poses[:, 3:])
        return Cameras(*moved, Lenses(log_scales, term))

    def relative(self, edges: IntArray) -> tuple[Array, Array, Array]:
        """Relative rotations (m, 3, 3), directions (m, 3) and baselines (m,) of edges."""
        i, j = edges.T
        relative = self.rotations[j] @ np.swapaxes(self.rotations[i], 1, 2)
        baseline = np.einsum("kab,kb->ka", self.rotations[i], self.centers[j] - self.centers[i])
        length = np.linalg.norm(baseline, axis=1)
        short = length < SHORTEST_BASELINE
        directions = np.where(short[:, None], [0.0, 0.0, 1.0], normalized(baseline))
        return relative, directions, np.where(short, SHORTEST_BASELINE, length)

    def about_middle(self, images: IntArray) -> TripletPoses:
        """Poses of triplets (q, 3) relative to their middle images."""
        a, b, c = images.T
        R_b = self.rotations[b]
        baselines = np.stack([np.einsum("kab,kb->ka", R_b, self.centers[b] - self.centers[s]) for s in (a, c)])
        short = np.linalg.norm(baselines, axis=2, keepdims=True) < SHORTEST_BASELINE
        return TripletPoses(
            np.stack([R_b @ np.swapaxes(self.rotations[s], 1, 2) for s in (a, c)]),
            np.where(short, [0.0, 0.0, SHORTEST_BASELINE], baselines),
        )


class CameraSteps:
    """Steps along which the relative poses of linked images change nearly linearly.

    Parameters
    ----------
    cameras : Cameras
        About where the steps are taken: shorter baselines count more in the positions.
    edges : (m, 2) int64 array
        Linked images.
    """

    def __init__(self, cameras: Cameras, edges: IntArray) -> None:
        self._first, self._second = edges.T
        length = np.linalg.norm(cameras.centers[self._second] - cameras.centers[self._first], axis=1)
        self._weights = 1.0 / np.square(np.maximum(length, max(0.1 * float(np.median(length)), SHORTEST_BASELINE)))
        self._system = LaplacianSystem(len(cameras.centers), edges)
        self._factor = self._system.factor(self._weights)

    def taken(self, cameras: Cameras, step: Array, free: IntArray) -> Cameras:
        """Cameras after a step (6 n + f,), as of :meth:`Cameras.moved`, to which this is equal to first order.

        The motion of an image relative to its neighbours is limited, so that it does not jump at the gain of others.
        """
        n = len(cameras.centers)
        poses = step[: 6 * n].reshape(n, 6)
        poses = poses / np.maximum(self._excess(cameras, poses), 1.0)[:, None]
        poses = poses / max(float(np.linalg.norm(poses[:, :3], axis=1).max()) / _MAX_WHOLE_TURN, 1.0)
        plain = cameras.moved(np.concatenate([poses.ravel(), step[6 * n :]]), free)
        # Baselines (m, 3) with the new rotations, by what each end's frame sees of the step.
        turned = [
            np.einsum("kba,kb->ka", plain.rotations[end], seen + change)
            for end, (seen, change) in zip((self._first, self._second), self._baselines(cameras, poses), strict=True)
        ]
        centers = cameras.centers + poses[:, 3:]
        off = 0.5 * (turned[0] + turned[1]) - (centers[self._second] - centers[self._first])
        centers = centers + self._factor.solve(self._system.right_side(self._weights, off))
        return Cameras(plain.rotations, gauged(centers), plain.lenses)

    def _baselines(self, cameras: Cameras, poses: Array) -> list[tuple[Array, Array]]:
        """Baselines (m, 3) in the frames of first and second images, and their changes by a step (n, 6)."""
        turns, shifts = poses[:, :3], poses[:, 3:]
        along, change = (x[self._second] - x[self._first] for x in (cameras.centers, shifts))
        found = []
        for end in (self._first, self._second):
            R = cameras.rotations[end]
            seen = np.einsum("kab,kb->ka", R, along)
            found.append((seen, np.einsum("kab,kb->ka", R, change) + np.cross(turns[end], seen)))
        return found

    def _excess(self, cameras: Cameras, poses: Array) -> Array:
        """Motion (n,) of each image relative to the neighbour with which it agrees best, over the largest allowed."""
        changes = [np.linalg.norm(change, axis=1) for _, change in self._baselines(cameras, poses)]
        turns = np.einsum("nba,nb->na", cameras.rotations, poses[:, :3])
        apart = np.linalg.norm(turns[self._second] - turns[self._first], axis=1)
        excess = np.maximum(np.maximum(*changes) * np.sqrt(self._weights) / _MAX_SHIFT, apart / _MAX_TURN)
        least = np.full(len(poses), np.inf)
        np.minimum.at(least, self._first, excess)
        np.minimum.at(least, self._second, excess)
        return np.where(np.isfinite(least), least, 1.0)


def gauged(centers: Array) -> Array:
    """Positions with centroid 0 and root mean square distance 1.

    Raises
    ------
    GraphError
        All positions coincide.
    """
    centered = centers - centers.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(centered**2, axis=1)))
    if not spread > 0:
        raise GraphError("epipolar adjustment: all cameras coincide")
    return np.asarray(centered / spread)
