"""Normal equations of poses and lenses, from which all points are eliminated (Schur complement).

With the Cholesky factor ``L`` of a point's own equations, an observation's derivatives ``F`` by its image's unknowns
and ``A`` by its point, and ``Z = F^T A L^-T``, two images share the block ``-sum Z_i Z_j^T`` over their common points.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.bundle.linearization import Linearization, derivatives_by_lens
from colmap_vg.bundle.point_systems import PointFactors, factored, gradients
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import BlockPattern, scattered
from colmap_vg.linear.solvers import factorize

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_DAMPING = 1e-11
"""Share of the diagonal that is always added, since the gauge leaves seven degrees of freedom."""


class ReducedPattern:
    """Sparsity of the reduced system, analysed once.

    Parameters
    ----------
    problem : BundleProblem
    """

    def __init__(self, problem: BundleProblem) -> None:
        pairs = [np.stack(np.unique(images, return_index=True)) for _, _, images in problem.common]
        self.pairs = np.concatenate(
            [np.stack([np.full(found.shape[1], i), found[0]], axis=1) for i, found in enumerate(pairs)]
        )
        """(m, 2): images with points in common."""
        self.cuts = [np.append(found[1], len(own[0])) for found, own in zip(pairs, problem.common, strict=True)]
        """For each image, where the pairs begin within `BundleProblem.common`."""
        self.poses = BlockPattern(problem.num_images, self.pairs, 6)


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """Normal equations of the unknowns of poses and lenses.

    Attributes
    ----------
    free : (f,) int64 array
        Unknowns that are not of held poses.
    matrix : (u, u) csc_array
    gradient : (u,) array
    rays : (3, k) array
        Point minus projection centre, world frame.
    by_lens : (2, t, k) array
        Derivatives of the residuals by the unknowns of their lenses.
    by_point : (2, 3, k) array
        Derivatives by points, fixed or not.
    across : (2, 3, k) array
        Those times ``L^-T``, zero for fixed points.
    factors : PointFactors
    of_points : (3, q) array
        Gradients of points times ``L^-1``.
    """

    free: IntArray
    matrix: sp.csc_array
    gradient: Array
    rays: Array
    by_lens: Array
    by_point: Array
    across: Array
    factors: PointFactors
    of_points: Array

    @classmethod
    def of(
        cls, problem: BundleProblem, pattern: ReducedPattern, state: BundleState, found: Linearization
    ) -> "ReducedSystem":
        """Assemble the system at a state and its linearization."""
        q, rows, by_point = len(found.costs), problem.point_row, found.by_moving_point(problem)
        factors = factored(q, rows, by_point)
        of_points = factors.lower(gradients(q, rows, by_point, found.residuals))
        own_factors = factors.at(rows)
        across = np.stack([own_factors.lower(by_point[0]), own_factors.lower(by_point[1])])
        by_lens = derivatives_by_lens(problem, state, found)
        own, pairs, gradient = _blocks(problem, pattern, found, by_lens, across, of_points)
        matrix = _assembled(problem, pattern, own, pairs)
        places, used = problem.unknowns.ravel(), problem.unknowns.ravel() >= 0
        total = np.bincount(places[used], gradient.ravel()[used], minlength=problem.num_unknowns)
        return cls(
            problem.free,
            matrix,
            np.asarray(total, dtype=np.float64),
            found.rays,
            by_lens,
            found.by_point,
            across,
            factors,
            of_points,
        )

    def step(self, damping: float) -> Array:
        """Levenberg step (u,), with damping relative to the diagonal; 0 for held poses.

        Raises
        ------
        SingularMatrixError
            The observations do not determine all unknowns.
        """
        matrix, step = self.matrix, np.zeros(len(self.gradient))
        if len(self.free) < len(step):
            matrix = matrix[self.free][:, self.free]
        diagonal = matrix.diagonal()
        # Images without observations do not move.
        least = np.finfo(np.float64).tiny + 1e-15 * diagonal.max(initial=0.0)
        level = np.maximum((damping + MIN_DAMPING) * diagonal, least)
        step[self.free] = -factorize(sp.csc_array(matrix + sp.diags_array(level))).solve(self.gradient[self.free])
        return step

    def steps_of_points(self, problem: BundleProblem, step: Array, relaxation: float) -> Array:
        """Steps (q, 3) of the points that go with a step of the unknowns: its effect, and their own times a factor."""
        changes = self._changes(problem, step)
        induced = gradients(self.of_points.shape[1], problem.point_row, self.across, changes)
        return -self.factors.upper(induced + relaxation * self.of_points).T

    def correction(
        self, problem: BundleProblem, step: Array, shifts: Array, change: Array, damping: float
    ) -> tuple[Array, Array]:
        """Add to a step what takes back the part of its change of the residuals that is not linear.

        Parameters
        ----------
        problem : BundleProblem
        step : (u,) array
            Of the unknowns.
        shifts : (q, 3) array
            Steps of the points with it.
        change : (2, k) array
            Change of the residuals, with the weights of the system.
        damping : float
            As of the step.

        Returns
        -------
        step : (u,) array
        shifts : (q, 3) array
        """
        linear = self._changes(problem, step)
        moved = np.take(np.ascontiguousarray(shifts.T), problem.point_row, axis=1)
        bent = change - linear - np.einsum("abk,bk->ak", self.by_point, moved)
        of_points = gradients(len(shifts), problem.point_row, self.across, bent)
        left = bent - np.einsum("abk,bk->ak", self.across, np.take(of_points, problem.point_row, axis=1))
        gradient = np.zeros(len(self.gradient) + 1)
        for row, own in zip(problem.unknowns, problem.of_images, strict=True):
            D = _by_unknowns(self.by_point[:, :, own], self.rays[:, own], self.by_lens[:, :, own])
            gradient[row] += np.einsum("awk,ak->w", D, left[:, own])
        further = replace(self, gradient=gradient[:-1], of_points=of_points)
        more = further.step(damping)
        return more, further.steps_of_points(problem, more, 1.0)

    def _changes(self, problem: BundleProblem, step: Array) -> Array:
        """Linear changes (2, k) of the residuals by a step (u,) of the unknowns, with the points fixed."""
        padded, changes = np.append(step, 0.0)[problem.unknowns], np.empty((2, self.rays.shape[1]))
        for (turn, shift, by_lens), own in zip(
            ((row[:3], row[3:6], row[6:]) for row in padded), problem.of_images, strict=True
        ):
            # With dr/dw = -A x d row by row: its product with w is A (w x d).
            by_ray = so3.hat(turn) @ self.rays[:, own] - shift[:, None]
            changes[:, own] = np.einsum("abk,bk->ak", self.by_point[:, :, own], by_ray)
            if len(by_lens):
                changes[:, own] += np.einsum("atk,t->ak", self.by_lens[:, :, own], by_lens)
        return changes


def _by_unknowns(A: Array, d: Array, by_lens: Array) -> Array:
    """Derivatives (2, w, k) by rotation, position and lens of one image, from those by points and the world rays."""
    derivatives = np.empty((2, 6 + by_lens.shape[1], d.shape[1]))
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        derivatives[:, axis] = A[:, last] * d[after] - A[:, after] * d[last]
    np.negative(A, out=derivatives[:, 3:6])
    derivatives[:, 6:] = by_lens
    return derivatives


def _blocks(
    problem: BundleProblem,
    pattern: ReducedPattern,
    found: Linearization,
    by_lens: Array,
    across: Array,
    of_points: Array,
) -> tuple[Array, Array, Array]:
    """Blocks of images (n, w, w) and of pairs (m, w, w), and gradients (n, w)."""
    width, residuals = problem.unknowns.shape[1], found.residuals
    eliminated = np.empty((residuals.shape[1], 3, width))
    own, gradient = np.empty((problem.num_images, width, width)), np.empty((problem.num_images, width))
    for image, at in enumerate(problem.of_images):
        D, A = _by_unknowns(found.by_point[:, :, at], found.rays[:, at], by_lens[:, :, at]), across[:, :, at]
        eliminated[at] = (D[0] * A[0][:, None] + D[1] * A[1][:, None]).transpose(2, 0, 1)
        F, Z = D.transpose(2, 0, 1).reshape(-1, width), eliminated[at].reshape(-1, width)
        own[image] = F.T @ F - Z.T @ Z
        point_gradients = np.take(of_points, problem.point_row[at], axis=1).T.ravel()
        gradient[image] = F.T @ residuals[:, at].T.ravel() - Z.T @ point_gradients
    pairs, place = np.empty((len(pattern.pairs), width, width)), 0
    for (first, second, _), cuts in zip(problem.common, pattern.cuts, strict=True):
        left, right = np.take(eliminated, first, axis=0), np.take(eliminated, second, axis=0)
        for start, end in pairwise(cuts):
            pairs[place] = -left[start:end].reshape(-1, width).T @ right[start:end].reshape(-1, width)
            place += 1
    return own, pairs, gradient


def _assembled(problem: BundleProblem, pattern: ReducedPattern, own: Array, pairs: Array) -> sp.csc_array:
    n, u = problem.num_images, problem.num_unknowns
    nothing = np.zeros((len(pairs), 6, 6))
    poses = pattern.poses.assemble(nothing, nothing, pairs[:, :6, :6], own[:, :6, :6])
    if u == 6 * n:
        return poses
    i, j = pattern.pairs.T
    rows, lenses = problem.unknowns[:, :6], np.maximum(problem.unknowns[:, 6:] - 6 * n, -1)
    shape = (6 * n, u - 6 * n)
    cross = scattered(
        np.concatenate([own[:, :6, 6:], pairs[:, :6, 6:], np.swapaxes(pairs[:, 6:, :6], 1, 2)]),
        np.concatenate([rows, rows[i], rows[j]]),
        np.concatenate([lenses, lenses[j], lenses[i]]),
        shape,
    )
    between = scattered(
        np.concatenate([own[:, 6:, 6:], pairs[:, 6:, 6:], np.swapaxes(pairs[:, 6:, 6:], 1, 2)]),
        np.concatenate([lenses, lenses[i], lenses[j]]),
        np.concatenate([lenses, lenses[j], lenses[i]]),
        (shape[1], shape[1]),
    )
    return sp.csc_array(sp.block_array([[poses, cross], [cross.T, between]]))
