"""Votes of matches for how far one image is turned and scaled against the other.

Right matches of a pair agree on a rotation within the image and a change of scale, and false ones do not (weak
geometric consistency; Jegou, Douze and Schmid, ECCV 2008).
"""

import numpy as np
from numpy.typing import NDArray

ROTATION_BINS = 12
SCALE_BINS = 10
"""Octaves; the first and the last bin take what is beyond them."""
CHANCE = 0.2
"""Share of false matches that agree: they favour the scales that are frequent, and images held the same way."""

Array = NDArray[np.float64]
Keypoints = NDArray[np.float32]


def log2_scales(keypoints: Keypoints) -> Array:
    """Logarithm to base 2 of the scales (k,) of keypoints (k, 6): x, y and the affine shape, pixels."""
    shape = keypoints[:, 2:6].astype(np.float64)
    area = np.abs(shape[:, 0] * shape[:, 3] - shape[:, 1] * shape[:, 2])
    return np.asarray(0.5 * np.log2(np.maximum(area, np.finfo(np.float32).tiny)))


def orientations(keypoints: Keypoints) -> Array:
    """Orientations (k,) of keypoints (k, 6), radians."""
    return np.asarray(np.arctan2(keypoints[:, 4], keypoints[:, 2]), dtype=np.float64)


def num_agreeing(rotations: Array, log2_scale_changes: Array) -> int:
    """Largest number of matches that agree on a rotation within 60 degrees and a change of scale within two octaves.

    Parameters
    ----------
    rotations : (k,) array
        Differences of the matched features' orientations, radians; any multiple of a turn may be added.
    log2_scale_changes : (k,) array
        Differences of their `log2_scales`.
    """
    rotation = np.floor(rotations * (ROTATION_BINS / (2 * np.pi))).astype(np.int64) % ROTATION_BINS
    scale = np.clip(np.floor(log2_scale_changes).astype(np.int64) + SCALE_BINS // 2, 0, SCALE_BINS - 1)
    votes = np.bincount(rotation * SCALE_BINS + scale, minlength=ROTATION_BINS * SCALE_BINS)
    votes = votes.reshape(ROTATION_BINS, SCALE_BINS)
    votes = votes + np.roll(votes, 1, axis=0)
    return int((votes[:, 1:] + votes[:, :-1]).max())


def excess_over_chance(num_consistent: NDArray[np.int32], num_matches: NDArray[np.int32]) -> Array:
    """Number of consistent matches beyond what false ones bring about, by two standard deviations; 0 at least."""
    by_chance = CHANCE * num_matches
    return np.asarray(np.maximum(num_consistent - by_chance - 2.0 * np.sqrt(by_chance), 0.0))
