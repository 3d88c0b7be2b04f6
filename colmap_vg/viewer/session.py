"""A session of the explorer: marks on pairs and images, the solution before and after them, and the lists to save."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.pair_lists import pair_list
from colmap_vg.errors import OutputError
from colmap_vg.geometry import so3
from colmap_vg.geometry.robust_similarity import align_robustly
from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.jobs.graph import solve_options
from colmap_vg.scene.marked_pairs import with_marked_pairs
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import ImageVerdict
from colmap_vg.solver.solve import solve_view_graph
from colmap_vg.viewer.finished_job import FinishedJob

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

EXCLUDED_NAME, TRUSTED_NAME = "excluded_pairs.txt", "trusted_pairs.txt"
MIN_COMMON = 3
"""Minimum number of common images that align two solutions."""
MIN_SHIFT_PERCENT, MIN_TURN_DEG, MAX_TOLD = 1.0, 1.0, 12
"""An image has moved if its shift exceeds this share of the scene's radius, or its turn this angle; number of images
told at most."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """What a new solution changed.

    Attributes
    ----------
    gained, lost : (k,) int64 array
        Rows of the images that were registered only after, and only before.
    shifts : (n,) array
        Distance between an image's positions, percent of the radius of the solution before; NaN where it has only one.
    turns : (n,) array
        Angle between its rotations, degrees.
    """

    gained: IntArray
    lost: IntArray
    shifts: Array
    turns: Array

    @property
    def moved(self) -> IntArray:
        """Rows of the images that moved, the farthest first."""
        far = np.flatnonzero((self.shifts > MIN_SHIFT_PERCENT) | (self.turns > MIN_TURN_DEG))
        return far[np.argsort(-self.shifts[far], kind="stable")]


class Session:
    """Marks on the pairs and images of a finished job, and its viewing graph's solution before and after them.

    Attributes
    ----------
    job : FinishedJob
    excluded, trusted : (m,) bool array
        Marks on pairs; no pair has both.
    excluded_images : (n,) bool array
        Images all of whose pairs are excluded.
    before : PoseSolution
        Of the job's graph with the job's own lists of pairs, in the frame and scale of the job's model.
    after : PoseSolution
        Of the graph with the marks of the last `solve`, likewise.
    seconds : float
        Time of the last solve.
    """

    def __init__(self, job: FinishedJob) -> None:
        self.job = job
        self.excluded, self.trusted = job.excluded.copy(), job.trusted.copy()
        self.excluded_images = np.zeros(job.graph.num_images, dtype=bool)
        self.before = self.after = _aligned(self._solved(), job.centers)

    @property
    def all_excluded(self) -> BoolArray:
        """Mask (m,) of the pairs that are excluded themselves or by one of their images."""
        return self.excluded | np.asarray(self.excluded_images[self.job.graph.edges].any(axis=1))

    def exclude_pair(self, pair: int) -> None:
        """Mark a pair, by its row, as not to be used."""
        self.excluded[pair], self.trusted[pair] = True, False

    def trust_pair(self, pair: int) -> None:
        """Mark a pair as one that no filter may drop."""
        self.excluded[pair], self.trusted[pair] = False, True

    def clear_pair(self, pair: int) -> None:
        """Remove the mark of a pair."""
        self.excluded[pair] = self.trusted[pair] = False

    def exclude_image(self, image: int, excluded: bool = True) -> None:
        """Exclude all pairs of an image, by its row, or take that back."""
        self.excluded_images[image] = excluded

    def clear(self) -> None:
        """Return to the job's own lists of pairs."""
        self.excluded, self.trusted = self.job.excluded.copy(), self.job.trusted.copy()
        self.excluded_images[:] = False

    def solve(self) -> Comparison:
        """Solve the viewing graph with the current marks, as `colmap-vg mapper` does with the saved lists."""
        before = np.where(self.before.registered[:, None], self.before.projection_centers, np.nan)
        self.after = _aligned(self._solved(), before)
        return self.comparison()

    def comparison(self) -> Comparison:
        """Compare the solutions before and after."""
        before, after = self.before, self.after
        both = before.registered & after.registered
        shifts, turns = np.full((2, len(both)), np.nan)
        centers = before.projection_centers[before.registered]
        if both.any():
            radius = float(np.sqrt(np.mean(np.sum((centers - centers.mean(axis=0)) ** 2, axis=1))))
            apart = after.projection_centers[both] - before.projection_centers[both]
            shifts[both] = 100.0 * np.linalg.norm(apart, axis=1) / radius
            turned = before.cam_from_world_rotations[both].swapaxes(1, 2) @ after.cam_from_world_rotations[both]
            turns[both] = np.degrees(so3.angle(turned))
        return Comparison(
            np.flatnonzero(after.registered & ~before.registered),
            np.flatnonzero(before.registered & ~after.registered),
            shifts,
            turns,
        )

    def told(self) -> list[str]:
        """Lines on the solution after the marks, and on what it changed."""
        names, after, found = self.job.graph.image_names, self.after, self.comparison()
        lines = [
            f"{int(self.before.registered.sum())} images registered before, {int(after.registered.sum())} after;"
            f" {int(self.before.edge_kept.sum())} pairs used before, {int(after.edge_kept.sum())} after"
            f" ({self.seconds:.2f} s).",
            after.message,
            *after.caveats,
        ]
        for row in found.lost[:MAX_TOLD].tolist():
            lines.append(f"lost: {names[row]}: {ImageVerdict.reason_of(after.image_verdicts[row])}")
        lines += [f"gained: {names[row]}" for row in found.gained[:MAX_TOLD].tolist()]
        for row in found.moved[:MAX_TOLD].tolist():
            lines.append(
                f"moved: {names[row]} by {found.shifts[row]:.1f} % of the radius, turned by {found.turns[row]:.1f}°"
            )
        hidden = sum(max(len(rows) - MAX_TOLD, 0) for rows in (found.lost, found.gained, found.moved))
        return [*lines, f"and {hidden} more images"] if hidden else lines

    def save(self, folder: Path) -> tuple[Path, Path]:
        """Write the lists of excluded and trusted pairs that `colmap-vg mapper` takes, each atomically.

        Returns
        -------
        excluded, trusted : Path

        Raises
        ------
        OutputError
            A list cannot be written.
        """
        names, edges = self.job.graph.image_names, self.job.graph.edges
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error
        paths = folder / EXCLUDED_NAME, folder / TRUSTED_NAME
        for path, marked in zip(paths, (self.all_excluded, self.trusted & ~self.all_excluded), strict=True):
            atomic_write(path, pair_list((names[i], names[j]) for i, j in edges[marked].tolist()))
        return paths

    def _solved(self) -> PoseSolution:
        graph = with_marked_pairs(self.job.graph, self.all_excluded, self.trusted)
        start = time.perf_counter()
        solution = solve_view_graph(graph, solve_options(self.job.options))
        self.seconds = time.perf_counter() - start
        return solution


def _aligned(solution: PoseSolution, centers: Array) -> PoseSolution:
    """The solution with its largest component where it fits known centres (n, 3) best; as it is if few are common."""
    inside = solution.registered
    common = inside & np.isfinite(centers).all(axis=1)
    if common.sum() < MIN_COMMON:
        return solution
    similarity = align_robustly(solution.projection_centers[common], centers[common]).similarity
    rotations, centers = solution.cam_from_world_rotations.copy(), solution.projection_centers.copy()
    rotations[inside] = rotations[inside] @ similarity.rotation.T
    centers[inside] = similarity.apply(centers[inside])
    return replace(solution, cam_from_world_rotations=rotations, projection_centers=centers)
