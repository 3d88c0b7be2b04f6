"""Reprojection errors of tracks, and their points' elimination from normal equations.

A point X is seen by a camera at ``u = R (X - p)``; against the observed bearing x with tangent basis B the residual is
``r = f B^T u / |u|`` in pixels. The Cauchy loss is on ``|r|^2``.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.epipolar.tracks import Tracks
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.two_view.segments import segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TrackEquations:
    """Robust cost, and blocks of the normal equations of cameras and points.

    Attributes
    ----------
    cost : float
    camera_gradient, point_gradient : (u,) and (3 t,) array
    camera_hessian : (u, u) csr_array
    mixed : (u, 3 t) csr_array
    point_blocks : (t, 3, 3) array
    """

    cost: float
    camera_gradient: Array
    point_gradient: Array
    camera_hessian: sp.csr_array
    mixed: sp.csr_array
    point_blocks: Array


class TrackErrors:
    """Errors of tracks on a pattern that is laid out once.

    Parameters
    ----------
    tracks : Tracks
    num_images : int
    focal_slots : (n,) int array
        Of each image's focal length among the free ones; -1 where it is held.
    num_focals : int
        Free focal lengths.
    """

    def __init__(self, tracks: Tracks, num_images: int, focal_slots: IntArray, num_focals: int) -> None:
        self.tracks, self._track = tracks, segment_of_rows(tracks.offsets)
        self._num_unknowns = 6 * num_images + num_focals
        count = len(tracks.images)
        columns = 6 * tracks.images[:, None] + np.arange(6)
        slots = focal_slots[tracks.images]
        self._with_focals = num_focals > 0
        if self._with_focals:
            # Held focal lengths get a column of zeros at the first pose unknown.
            columns = np.concatenate([columns, np.where(slots >= 0, 6 * num_images + slots, 0)[:, None]], axis=1)
            self._free = slots >= 0
        width = columns.shape[1]
        self._camera_columns = np.repeat(columns, 2, axis=0).ravel()
        self._camera_starts = np.arange(0, 2 * count * width + 1, width)
        self._point_columns = np.repeat(3 * self._track[:, None] + np.arange(3), 2, axis=0).ravel()
        self._point_starts = np.arange(0, 6 * count + 1, 3)

    def lengths(self, rotations: Array, centers: Array, points: Array, bearings: Array, focals: Array) -> Array:
        """Reprojection errors of the observations, pixels."""
        return np.asarray(np.linalg.norm(self._residuals(rotations, centers, points, bearings, focals)[0], axis=1))

    def cost(
        self, rotations: Array, centers: Array, points: Array, bearings: Array, focals: Array, scale: float
    ) -> float:
        """Robust cost, squared pixels; `focals` and `bearings` are those of the observations."""
        r = self._residuals(rotations, centers, points, bearings, focals)[0]
        return float(scale**2 * np.log1p(np.sum(r * r, axis=1) / scale**2).sum())

    def equations(
        self, rotations: Array, centers: Array, points: Array, bearings: Array, focals: Array, scale: float
    ) -> TrackEquations:
        """Normal equations by ``(w, x)`` of each image, log focal lengths, and points."""
        r, u, basis = self._residuals(rotations, centers, points, bearings, focals)
        length = np.maximum(np.linalg.norm(u, axis=1), 1e-12)
        along = u / length[:, None]
        squared = np.sum(r * r, axis=1)
        root_weight = np.sqrt(1.0 / (1.0 + squared / scale**2))
        by_u = basis - (basis @ along[:, :, None]) * along[:, None, :]
        by_u *= (root_weight * focals / length)[:, None, None]
        R = rotations[self.tracks.images]
        by_point = by_u @ R
        camera = [-by_u @ so3.hat(u), -by_point]
        if self._with_focals:
            # A longer focal draws the observed bearing x to the axis, dx = x_3 (e_3 - x_3 x), and B with it.
            toward = bearings[:, 2] * np.einsum("oa,oa->o", bearings, along)
            pull = toward[:, None] * basis[:, :, 2]
            by_focal = np.where(self._free, root_weight, 0.0)[:, None] * (r - focals[:, None] * pull)
            camera.append(by_focal[:, :, None])
        J = np.concatenate(camera, axis=2)
        shape = 2 * len(r), self._num_unknowns
        by_camera = sp.csr_array((J.ravel(), self._camera_columns, self._camera_starts), shape=shape)
        points_shape = 2 * len(r), 3 * self.tracks.num_tracks
        by_points = sp.csr_array((by_point.ravel(), self._point_columns, self._point_starts), shape=points_shape)
        weighted = (root_weight[:, None] * r).ravel()
        starts = self.tracks.offsets[:-1]
        blocks = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, starts, axis=0)
        return TrackEquations(
            float(scale**2 * np.log1p(squared / scale**2).sum()),
            by_camera.T @ weighted,
            by_points.T @ weighted,
            sp.csr_array(by_camera.T @ by_camera),
            sp.csr_array(by_camera.T @ by_points),
            blocks,
        )

    def _residuals(
        self, rotations: Array, centers: Array, points: Array, bearings: Array, focals: Array
    ) -> tuple[Array, Array, Array]:
        images = self.tracks.images
        u = np.einsum("oab,ob->oa", rotations[images], points[self._track] - centers[images])
        basis = np.swapaxes(tangent_basis(bearings), 1, 2)
        length = np.maximum(np.linalg.norm(u, axis=1), 1e-12)
        r = focals[:, None] * np.einsum("oab,ob->oa", basis, u) / length[:, None]
        # A point behind a camera projects as if it were before it: count it as a right angle off.
        behind = np.einsum("oa,oa->o", u, bearings) <= 0.0
        return np.where(behind[:, None], focals[:, None], r), u, basis
