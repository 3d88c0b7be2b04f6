"""What bundle adjustment is given: observations, lenses and the images of points; and what it changes, the state."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3

MAX_GROWTH = 2.0
"""Maximum change, either way, of the logarithm of a focal length or of a distance in one step."""
OBSERVATIONS_PER_RUN = 8192
"""Number of observations from which a run takes no further image."""

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class Lens(Protocol):
    """A camera model with some unknown parameters."""

    @property
    def free(self) -> IntArray:
        """Indices (t,) of the parameters that are unknown."""

    @property
    def focal(self) -> BoolArray:
        """Which of these are focal lengths: (t,)."""

    def project(self, parameters: Array, rays: Array) -> Array:
        """Project rays (k, 3) of the camera's frame: pixels (k, 2), NaN where a ray has no projection."""


@dataclass(frozen=True, eq=False)
class Run:
    """Observations of consecutive images with one lens, few enough for a processor's cache unless one image has more.

    Attributes
    ----------
    lens : int
    observations : slice
    first : int
        The first image.
    of_images : list of slice
        Observations of each image, counted from the first of the run.
    """

    lens: int
    observations: slice
    first: int
    of_images: list[slice]


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """Observations of q points in n images, sorted by image.

    Attributes
    ----------
    image_row, point_row : (k,) int64 array
        Image and point of each observation; images ascend.
    keypoints : (k, 2) array
        Pixels.
    camera_idx : (n,) int64 array
        Lens of each image, ascending.
    lenses : sequence of Lens
    held : (n,) bool array, optional
        Images whose poses stay; none by default.
    fixed : (q,) bool array, optional
        Points that stay; none by default.
    """

    image_row: IntArray
    point_row: IntArray
    keypoints: Array
    camera_idx: IntArray
    lenses: Sequence[Lens]
    held: BoolArray | None = None
    fixed: BoolArray | None = None

    @property
    def num_images(self) -> int:
        return len(self.camera_idx)

    @cached_property
    def starts(self) -> IntArray:
        """First observation of each image, and the number of observations: (n + 1,)."""
        return np.searchsorted(self.image_row, np.arange(self.num_images + 1))

    @cached_property
    def of_images(self) -> list[slice]:
        """Observations of each image."""
        return [slice(start, end) for start, end in pairwise(self.starts.tolist())]

    @cached_property
    def runs(self) -> list[Run]:
        """Runs of images with one lens, of about `OBSERVATIONS_PER_RUN` observations each."""
        found, first = list[Run](), 0
        lenses = self.camera_idx.tolist()
        for image in range(self.num_images):
            last = image + 1 == self.num_images or lenses[image + 1] != lenses[image]
            if last or self.starts[image + 1] - self.starts[first] >= OBSERVATIONS_PER_RUN:
                start = int(self.starts[first])
                own = [slice(at.start - start, at.stop - start) for at in self.of_images[first : image + 1]]
                found.append(Run(lenses[image], slice(start, int(self.starts[image + 1])), first, own))
                first = image + 1
        return found

    @cached_property
    def unknowns(self) -> IntArray:
        """Unknowns of each image: six of its pose, then those of its lens, which images may share: (n, w); -1 is none.

        Poses come first: unknown 6 i + c is component c of rotation and position of image i.
        """
        counts = np.array([len(lens.free) for lens in self.lenses], dtype=np.int64)
        first = 6 * self.num_images + np.concatenate([[0], np.cumsum(counts)])
        slots = np.arange(counts.max(initial=0))
        of_lens = np.where(slots < counts[:, None], first[:-1, None] + slots, -1)
        poses = np.arange(6 * self.num_images).reshape(-1, 6)
        return np.concatenate([poses, of_lens[self.camera_idx]], axis=1)

    @cached_property
    def free(self) -> IntArray:
        """The unknowns that are not of held poses: (f,)."""
        free = np.ones(self.num_unknowns, dtype=bool)
        if self.held is not None:
            free[: 6 * self.num_images] = np.repeat(~self.held, 6)
        return np.flatnonzero(free)

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns, those of held poses included."""
        return 6 * self.num_images + sum(len(lens.free) for lens in self.lenses)

    @cached_property
    def common(self) -> list[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]]:
        """Observations of one point by two images: for each image i ``(own, other, images)``.

        Observation ``own[k]`` of image i and ``other[k]`` of a later image, ``images[k]``, which ascends.
        """
        by_point = np.argsort(self.point_row, kind="stable")
        place = np.empty_like(by_point)
        place[by_point] = np.arange(len(by_point))
        last = np.searchsorted(self.point_row[by_point], self.point_row, side="right")
        found = []
        for start, end in zip(self.starts[:-1], self.starts[1:], strict=True):
            own = np.arange(start, end)
            following = last[own] - place[own] - 1
            repeated = np.repeat(own, following)
            rank = np.arange(len(repeated)) - np.repeat(np.cumsum(following) - following, following)
            other = by_point[place[repeated] + 1 + rank]
            order = np.argsort(other, kind="stable")
            own, other = repeated[order].astype(np.int32), other[order].astype(np.int32)
            found.append((own, other, self.image_row[other].astype(np.int32)))
        return found


@dataclass(frozen=True, eq=False)
class BundleState:
    """Values of the unknowns.

    Attributes
    ----------
    rotations : (n, 3, 3) array
        cam_from_world.
    centers : (n, 3) array
        Projection centres, world frame.
    points : (q, 3) array
        World frame.
    parameters : list of (p,) arrays
        All parameters of each lens.
    """

    rotations: Array
    centers: Array
    points: Array
    parameters: list[Array] = field(default_factory=list)

    def viewed(self, problem: BundleProblem) -> Array:
        """What each image looks at: (n, 3), the harmonic mean of the distances of its points away."""
        n, row = problem.num_images, problem.image_row
        rays = self.points[problem.point_row] - self.centers[row]
        nearness = 1.0 / np.maximum(np.linalg.norm(rays, axis=1), np.finfo(np.float64).tiny)
        ahead = np.stack([np.bincount(row, nearness * rays[:, axis], minlength=n) for axis in range(3)], axis=1)
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1), np.finfo(np.float64).tiny)[:, None]
        count, total = np.bincount(row, minlength=n), np.bincount(row, nearness, minlength=n)
        distance = count / np.maximum(total, np.finfo(np.float64).tiny)
        return np.asarray(self.centers + distance[:, None] * ahead)

    def moved(self, problem: BundleProblem, step: Array, points: Array, viewed: Array) -> "BundleState":
        """Take a step (u,) of the unknowns, with new points (q, 3).

        Focal lengths and distances from what an image looks at, `viewed` (n, 3), are multiplied, not added to: it is
        their ratios that keypoints tell, so that what hardly changes the cost is straight in their logarithms.
        """
        poses = step[: 6 * problem.num_images].reshape(-1, 6)
        parameters, place = [], 6 * problem.num_images
        for lens, before in zip(problem.lenses, self.parameters, strict=True):
            after, end = before.copy(), place + len(lens.free)
            own, by = before[lens.free], step[place:end]
            growth = np.clip(by / np.where(lens.focal, own, np.inf), -MAX_GROWTH, MAX_GROWTH)
            after[lens.free] = np.where(lens.focal, own * np.exp(growth), own + by)
            parameters.append(after)
            place = end
        away = self.centers - viewed
        squared = np.maximum(np.einsum("na,na->n", away, away), np.finfo(np.float64).tiny)
        growth = (np.einsum("na,na->n", away, poses[:, 3:]) / squared)[:, None]
        sideways = poses[:, 3:] - growth * away
        growth = np.clip(growth, -MAX_GROWTH, MAX_GROWTH)
        centers = self.centers + np.expm1(growth) * away + np.exp(growth) * sideways
        return BundleState(self.rotations @ so3.exp(poses[:, :3]), centers, points, parameters)
