"""Observations of some of a model's points as arrays, and the scale of the robust loss that suits their residuals."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.linear.robust_losses import cauchy_weight

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

NUM_SAMPLED_OBSERVATIONS = 4000
"""Observations from which the scale of the loss is estimated, about this many, of points drawn evenly from all: their
residuals tell it to a few per cent."""
MIN_SIGMA_PX = 0.1
"""Minimum standard deviation of keypoints, pixels: that of the sharpest detectors."""
SCALES_IN_SIGMAS = np.geomspace(0.8, 16.0, 25)
"""Candidates for the scale of the loss: from tails of a Cauchy distribution to none, where it is that of squares."""
_MEDIAN_NORM = 1.1774
"""Median norm of a 2-vector of standard normal deviates."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of q points in n images.

    Attributes
    ----------
    positions : (q, 3) array
        World frame.
    point_row, image_row : (k,) int64 array
        Point and image of each observation.
    images : list of pycolmap.Image
    keypoints : (k, 2) array
        Pixels.
    """

    positions: Array
    point_row: IntArray
    image_row: IntArray
    images: list["pycolmap.Image"]
    keypoints: Array

    @classmethod
    def of(
        cls, reconstruction: "pycolmap.Reconstruction", seen: ModelObservations, point_ids: IntArray
    ) -> "Observations":
        """Take the observations of some points, at least one, whose ids ascend."""
        place = np.searchsorted(point_ids, seen.point_ids)
        own = np.flatnonzero(point_ids[np.minimum(place, len(point_ids) - 1)] == seen.point_ids)
        image_ids, image_row = np.unique(seen.image_ids[own], return_inverse=True)
        images = [reconstruction.image(image_id) for image_id in image_ids.tolist()]
        return cls(seen.positions_of(point_ids), place[own], image_row.reshape(-1), images, seen.keypoints[own])

    @property
    def rotations(self) -> Array:
        """cam_from_world rotations of the images: (n, 3, 3)."""
        return np.array([image.cam_from_world().rotation.matrix() for image in self.images])

    @property
    def centers(self) -> Array:
        """Projection centres of the images, world frame: (n, 3)."""
        return np.array([image.projection_center() for image in self.images])

    @property
    def camera_ids(self) -> IntArray:
        """Camera of each observation: (k,)."""
        return np.array([image.camera_id for image in self.images], dtype=np.int64)[self.image_row]

    def reprojection_errors(self, reconstruction: "pycolmap.Reconstruction") -> Array:
        """Distances (k,) of the projections from the keypoints, pixels; NaN behind a camera or off its lens."""
        local = self.positions[self.point_row] - self.centers[self.image_row]
        local = np.einsum("kab,kb->ka", self.rotations[self.image_row], local)
        errors, camera_ids = np.full(len(local), np.nan), self.camera_ids
        for camera_id in np.unique(camera_ids).tolist():
            own = camera_ids == camera_id
            projected = np.asarray(reconstruction.camera(camera_id).img_from_cam(local[own])).reshape(-1, 2)
            errors[own] = np.linalg.norm(projected - self.keypoints[own], axis=1)
        return errors


def loss_scale(
    reconstruction: "pycolmap.Reconstruction", min_track_length: int, seen: ModelObservations | None = None
) -> float:
    """Scale of a Cauchy loss for the residuals of a model, pixels; that of `MIN_SIGMA_PX` without points.

    Of candidates in standard deviations the one under which the estimated parameters have the least variance,
    ``E[psi^2] / E[psi']^2`` (Huber, Robust Statistics, 1981, section 3.2), with the residuals' own distribution: where
    their tails are heavy, as those of photographs, a loss narrower than for normal noise; under normal noise squares.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    min_track_length : int
        Shorter tracks do not count.
    seen : ModelObservations, optional
        Of the reconstruction, where they are known.
    """
    squared = _squared_errors(reconstruction, min_track_length, seen)
    if not len(squared):
        return float(SCALES_IN_SIGMAS[0] * MIN_SIGMA_PX)
    sigma = _sigma(squared)
    return sigma * float(SCALES_IN_SIGMAS[np.argmin(variances(squared / sigma**2, SCALES_IN_SIGMAS))])


def keypoint_sigma(reconstruction: "pycolmap.Reconstruction", min_track_length: int) -> float:
    """Standard deviation of keypoints, pixels, by the median residual of a model's tracks of some length."""
    squared = _squared_errors(reconstruction, min_track_length, None)
    return _sigma(squared) if len(squared) else MIN_SIGMA_PX


def num_projected(reconstruction: "pycolmap.Reconstruction") -> int:
    """Number of observations of a sample of points that have a projection, whatever their error."""
    return len(_squared_errors(reconstruction, 2, None))


def _sigma(squared: Array) -> float:
    return max(float(np.sqrt(np.median(squared))) / _MEDIAN_NORM, MIN_SIGMA_PX)


def _squared_errors(
    reconstruction: "pycolmap.Reconstruction", min_track_length: int, seen: ModelObservations | None
) -> Array:
    """Squared residuals (k,) of a sample of points, as they would be of known points."""
    seen = seen or ModelObservations.of(reconstruction)
    point_ids, lengths = np.unique(seen.point_ids, return_counts=True)
    long = np.flatnonzero(lengths >= min_track_length)
    if not len(long):
        return np.zeros(0)
    share = min(1.0, NUM_SAMPLED_OBSERVATIONS / int(lengths[long].sum()))
    rows = np.linspace(0, len(long) - 1, max(round(share * len(long)), 1)).astype(np.int64)
    sample = Observations.of(reconstruction, seen, point_ids[long[np.unique(rows)]])
    # A point takes up three of the 2 L coordinates of its track, which reduces their residuals.
    length = np.bincount(sample.point_row)[sample.point_row]
    errors = sample.reprojection_errors(reconstruction) / np.sqrt(np.maximum(1.0 - 1.5 / length, 0.25))
    return np.asarray(np.square(errors[np.isfinite(errors)]))


def variances(squared: Array, scales: Array) -> Array:
    """Variance (s,) of an estimate under Cauchy losses of different scales, over that of one exact residual.

    Parameters
    ----------
    squared : (k,) array
        Squared norms of the residuals, which have two coordinates.
    scales : (s,) array
    """
    weights = cauchy_weight(squared / np.square(scales)[:, None])
    # For psi = w r, half the trace of its derivative by r is w^2.
    return np.asarray(0.5 * (np.square(weights) * squared).mean(axis=1) / np.square(np.square(weights).mean(axis=1)))
