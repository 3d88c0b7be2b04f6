"""Sparse normal equations of camera poses and shared lenses, from cost terms of two or three cameras each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, scattered, sum_at_nodes
from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_DAMPING = 1e-9
"""Share of the Hessian's diagonal that is always added, since the gauge leaves seven degrees of freedom."""


@dataclass(frozen=True, eq=False)
class CameraTerms:
    """Cost terms of s cameras each, with their derivatives.

    Attributes
    ----------
    images : (q, s) int64 array
    costs : (q,) array
    pose_gradients : (q, 6 s) array
        Derivatives by rotation and position of each image.
    lens_gradients : (q, t) array
        Derivatives by lens unknowns: none, or the log focal lengths of the images' cameras (t = s), or these and a
        radial term that all cameras share (t = s + 1).
    pose_blocks : (q, 6 s, 6 s) array
        Hessians by poses.
    cross_blocks : (q, 6 s, t) array
        Hessians by poses and lens unknowns.
    lens_blocks : (q, t, t) array
        Hessians by lens unknowns.
    """

    images: IntArray
    costs: Array
    pose_gradients: Array
    lens_gradients: Array
    pose_blocks: Array
    cross_blocks: Array
    lens_blocks: Array

    @classmethod
    def chained(cls, images: IntArray, costs: Array, gradients: Array, hessians: Array, chain: Array) -> "CameraTerms":
        """Apply the chain rule: derivatives (q, b + t) by b parameters and t of lenses, chain (q, b, 6 s) to poses."""
        b = chain.shape[1]
        turned = np.swapaxes(chain, 1, 2)
        return cls(
            images,
            costs,
            (gradients[:, None, :b] @ chain)[:, 0],
            gradients[:, b:],
            turned @ hessians[:, :b, :b] @ chain,
            turned @ hessians[:, :b, b:],
            hessians[:, b:, b:],
        )


class NormalSystem:
    """Gradients and Levenberg steps for terms of a fixed sparsity pattern, which is analysed once.

    Parameters
    ----------
    num_images : int
    images : sequence of (q, s) int64 arrays
        Images of the terms, one array for each kind.
    camera_idx : (n,) int64 array
        Camera of each image.
    free : (f,) int64 array
        Cameras whose focal lengths are unknowns.
    num_cameras : int
    with_radial : bool
        Whether a radial term is the last unknown.
    """

    def __init__(
        self,
        num_images: int,
        images: Sequence[IntArray],
        camera_idx: IntArray,
        free: IntArray,
        num_cameras: int,
        *,
        with_radial: bool = False,
    ) -> None:
        self.num_images, self.free = num_images, free
        self.num_lens_unknowns = len(free) + with_radial
        place = np.full(num_cameras, -1)
        place[free] = np.arange(len(free))
        self._images, self._slots = list(images), [place[camera_idx[i]] for i in images]
        if with_radial:
            self._slots = [np.pad(slot, ((0, 0), (0, 1)), constant_values=len(free)) for slot in self._slots]
        self._pattern = BlockPattern(num_images, np.concatenate([_pairs(i) for i in images]), 6)

    def gradient(self, terms: Sequence[CameraTerms]) -> Array:
        """Sum of the terms' gradients: (6 n + u,), u lens unknowns."""
        return self.summed([t.pose_gradients for t in terms], [t.lens_gradients for t in terms])

    def summed(self, by_poses: Sequence[Array], by_lenses: Sequence[Array]) -> Array:
        """Sum columns by poses (q, 6 s, ...) and by lenses (q, t, ...) over all terms: (6 n + u, ...)."""
        columns, count = by_poses[0].shape[2:], self.num_lens_unknowns
        poses = np.zeros((self.num_images, 6, *columns))
        lenses = np.zeros((count, *columns))
        for images, slot, by_pose, by_lens in zip(self._images, self._slots, by_poses, by_lenses, strict=True):
            poses += sum_at_nodes(self.num_images, images.ravel(), by_pose.reshape(-1, 6, *columns))
            used = slot >= 0
            if count:
                lenses += sum_at_nodes(count, slot[used], by_lens[used])
        return np.concatenate([poses.reshape(-1, *columns), lenses])

    def factor(self, terms: Sequence[CameraTerms]) -> Factor:
        """Factor the Hessian, damped only as much as the gauge requires.

        Raises
        ------
        SingularMatrixError
            The terms do not determine all cameras.
        """
        return factorize(self._matrix(terms, 0.0))

    def step(self, terms: Sequence[CameraTerms], gradient: Array, damping: float) -> Array | None:
        """Levenberg step (6 n + u,) with damping relative to the diagonal; None if the matrix is still singular."""
        try:
            return -factorize(self._matrix(terms, damping)).solve(gradient)
        except SingularMatrixError:
            return None

    def _matrix(self, terms: Sequence[CameraTerms], damping: float) -> sp.csc_array:
        n = self.num_images
        blocks = [np.concatenate(part) for part in zip(*(_split(t.pose_blocks) for t in terms), strict=True)]
        ii, jj, ij = blocks
        diagonal = np.zeros((n, 6))
        for t in terms:
            own = np.einsum("kaa->ka", t.pose_blocks).reshape(-1, 6)
            diagonal += sum_at_nodes(n, t.images.ravel(), own)
        level = damping * diagonal + MIN_DAMPING * diagonal.max(axis=0)
        matrix = self._pattern.assemble(ii, jj, ij, level[:, :, None] * np.eye(6))
        return self._bordered(matrix, terms, damping) if self.num_lens_unknowns else matrix

    def _bordered(self, poses: sp.csc_array, terms: Sequence[CameraTerms], damping: float) -> sp.csc_array:
        n, u = self.num_images, self.num_lens_unknowns
        cross, lenses = sp.csc_array((6 * n, u)), sp.csc_array((u, u))
        for term, slot in zip(terms, self._slots, strict=True):
            unknown = (6 * term.images[:, :, None] + np.arange(6)).reshape(len(slot), -1)
            cross = cross + scattered(term.cross_blocks, unknown, slot, (6 * n, u))
            lenses = lenses + scattered(term.lens_blocks, slot, slot, (u, u))
        level = lenses.diagonal() * damping
        lenses = lenses + sp.diags_array(level + 1e-12 * max(float(lenses.diagonal().max()), 1e-300))
        return sp.csc_array(sp.block_array([[poses, cross], [cross.T, lenses]]))


def _pairs(images: IntArray) -> IntArray:
    """Pairs of cameras of the terms, in the order of `_split`."""
    if images.shape[1] == 2:
        return images
    return np.concatenate([images[:, [s, (s + 1) % 3]] for s in range(3)])


def _split(blocks: Array) -> tuple[Array, Array, Array]:
    """Blocks ii, jj and ij of pairs; the diagonal block of each camera is assigned to one of its pairs."""
    if blocks.shape[1] == 12:
        return blocks[:, :6, :6], blocks[:, 6:, 6:], blocks[:, :6, 6:]
    parts = [slice(0, 6), slice(6, 12), slice(12, 18)]
    own = np.concatenate([blocks[:, s, s] for s in parts])
    across = np.concatenate([blocks[:, parts[s], parts[(s + 1) % 3]] for s in range(3)])
    return own, np.zeros_like(own), across
