"""SIFT features by OpenCV, in the form of COLMAP's databases.

Keypoints are rows ``x, y, a11, a12, a21, a22`` whose affine shape is ``sigma`` times a rotation, with the centre of the
first pixel at (0.5, 0.5). Descriptors are the roots of L1-normalised histograms times 512, in bytes, as COLMAP makes
them (Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012), so that
features of both match with one another.

The Gaussian pyramid of an image takes about 60 bytes for each pixel of the doubled first octave. Larger images are
therefore cut into tiles for the two finest octaves; the coarser ones come from the image at half its size.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

CONTRAST_THRESHOLD = 0.02
"""Least contrast of a feature, as a share of the full range, times OpenCV's number of scales per octave."""
MAX_PIXELS = 1_600_000
"""Pixels of an image whose pyramid is built at once: about 380 MB."""
TILE = 1024
"""Pixels; side of the tiles of larger images."""
_MARGIN = 64
"""Pixels around a tile: a descriptor of the second octave reaches 43, and its blur 12 more."""
_DESCRIPTOR_NORM = 512.0
_CHANNELS = 128

GreyArray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of an image, those of most contrast first.

    Attributes
    ----------
    keypoints : (k, 6) float32 array
        x, y in pixels and the affine shape, in columns of COLMAP's databases.
    descriptors : (k, 128) uint8 array
        Root-normalised, of norm near 512.
    contrasts : (k,) float32 array
        Of the features in the difference of Gaussians, shares of the full range.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    contrasts: NDArray[np.float32]

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Features":
        return Features(self.keypoints[rows], self.descriptors[rows], self.contrasts[rows])


def sift_features(
    grey: GreyArray, max_num_features: int, max_image_size: int, mask: NDArray[np.uint8] | None = None
) -> Features:
    """Find the SIFT features of most contrast.

    Parameters
    ----------
    grey : (h, w) uint8 array
    max_num_features : int
    max_image_size : int
        Pixels. Images whose longer side is larger are scaled down to it; keypoints are in pixels of `grey` even so.
    mask : (h, w) uint8 array, optional
        Features whose centre lies on a zero are discarded.

    Returns
    -------
    Features
    """
    scale = max_image_size / max(grey.shape)
    height, width = grey.shape
    small = grey
    if scale < 1.0:
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    detector = cv2.SIFT.create(
        nfeatures=max_num_features if mask is None else 0,
        contrastThreshold=CONTRAST_THRESHOLD,
        enable_precise_upscale=True,
    )
    points, descriptors = _detected(detector, small)
    points[:, 0] *= width / small.shape[1]
    points[:, 1] *= height / small.shape[0]
    points[:, 2] *= np.sqrt(grey.size / small.size)
    if mask is not None:
        columns, rows = points[:, 0].astype(np.int64), points[:, 1].astype(np.int64)
        seen = mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0
        points, descriptors = points[seen], descriptors[seen]
    strongest = np.lexsort((*points[:, :4].T, -points[:, 4]))[:max_num_features]
    points, descriptors = points[strongest], descriptors[strongest]
    return Features(_keypoints(points), _root_normalized(descriptors), points[:, 4].astype(np.float32))


def _detected(detector: "cv2.SIFT", grey: GreyArray) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Features as rows of x, y, sigma (pixels), angle (degrees), contrast and octave, and their descriptors."""
    if grey.size <= MAX_PIXELS:
        return _detected_at_once(detector, grey)
    coarse, descriptors = _detected(
        detector, np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    )
    coarse[:, 5] += 1
    kept = coarse[:, 5] >= 1
    coarse[:, :3] *= 2.0
    parts = [(coarse[kept], descriptors[kept])]
    for top, left in _corners(grey):
        fine, descriptors = _detected_at_once(
            detector,
            np.ascontiguousarray(
                grey[max(top - _MARGIN, 0) : top + TILE + _MARGIN, max(left - _MARGIN, 0) : left + TILE + _MARGIN]
            ),
        )
        fine[:, 0] += max(left - _MARGIN, 0)
        fine[:, 1] += max(top - _MARGIN, 0)
        kept = (fine[:, 0] >= left) & (fine[:, 0] < left + TILE) & (fine[:, 1] >= top) & (fine[:, 1] < top + TILE)
        kept &= fine[:, 5] <= 0
        parts.append((fine[kept], descriptors[kept]))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _corners(grey: GreyArray) -> Iterator[tuple[int, int]]:
    height, width = grey.shape
    return ((top, left) for top in range(0, height, TILE) for left in range(0, width, TILE))


def _detected_at_once(detector: "cv2.SIFT", grey: GreyArray) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    found, descriptors = detector.detectAndCompute(grey, None)
    if not len(found):
        return np.empty((0, 6)), np.empty((0, _CHANNELS), np.float32)
    rows = [
        (*point.pt, 0.5 * point.size, point.angle, point.response, (point.octave + 128) % 256 - 128) for point in found
    ]
    points = np.array(rows, dtype=np.float64)
    points[:, :2] += 0.5
    return points, np.asarray(descriptors, dtype=np.float32)


def _keypoints(points: NDArray[np.float64]) -> NDArray[np.float32]:
    sigma, angle = points[:, 2], np.radians(points[:, 3])
    along, across = sigma * np.cos(angle), sigma * np.sin(angle)
    return np.stack([points[:, 0], points[:, 1], along, -across, across, along], axis=1).astype(np.float32)


def _root_normalized(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.minimum(np.rint(_DESCRIPTOR_NORM * np.sqrt(shares)), 255.0), dtype=np.uint8)
