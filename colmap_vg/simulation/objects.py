"""Simulated viewing graphs of objects photographed from all sides, with nearly half of the pairs false.

Objects have repeated structure: opposite sides and repeated parts cause false pairs that agree with each other but not
with the scene, and whose relative poses are as precise as those of true pairs. They differ by their number of inliers:
on photographs of objects with known poses 84 to 96 % of the pairs with fewer than 30 inliers were false, and 0 to 3 %
of those with more than 300 (`FALSE_SHARES`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import SyntheticScene, look_at

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

FALSE_SHARES = ((15, 0.84, 0.96), (30, 0.53, 0.90), (60, 0.25, 0.66), (120, 0.06, 0.38), (300, 0.0, 0.03))
"""Rows of a number of inliers, and the share of pairs with at least that many that is false in an easy and in a hard
scene."""
MEDIAN_INLIERS, INLIER_SPREAD = 110.0, 1.1
"""Median number of inliers of a pair, and standard deviation of its logarithm (log-normal)."""
MIN_INLIERS = 15
"""Minimum number of inliers of a pair."""
SIDE_INLIERS, SIDE_WIDTH = 600.0, np.radians(35.0)
"""Matches of two views of one side from the same position, and the width, radians, of the Gaussian by which they
decrease with the angle between the views."""
MAX_VIEW_ANGLE = np.radians(75.0)
"""Twice the maximum angle, radians, between the viewing directions of a coherent false pair after moving the second."""


@dataclass(frozen=True)
class ObjectNoise:
    """Noise and false pairs of an object's viewing graph.

    Attributes
    ----------
    rotation_deg, direction_deg : float
        Standard deviation in each tangent axis of a pair with `MEDIAN_INLIERS` inliers, degrees.
    hardness : float
        Interpolates `FALSE_SHARES` between an easy (0) and a hard (1) scene.
    coherent_share : float
        Share of the false pairs, 0 to 1, that opposite sides and repeated parts cause; the others are random.
    focal_error : float
        Relative error of the focal length, by which relative rotations are too large.
    """

    rotation_deg: float = 0.3
    direction_deg: float = 1.5
    hardness: float = 0.5
    coherent_share: float = 0.5
    focal_error: float = 0.0


def object_scene(num_images: int, num_edges: int, noise: ObjectNoise | None = None, seed: int = 0) -> SyntheticScene:
    """Simulate the viewing graph of cameras on rings around an object.

    Parameters
    ----------
    num_images : int
        8 or more.
    num_edges : int
        Number of true and false pairs together, at least four per image.
    noise : ObjectNoise, optional
    seed : int

    Returns
    -------
    SyntheticScene
        `outlier` marks false pairs. Neighbours are linked by true pairs with many inliers.

    Raises
    ------
    OptionError
        There are too few images or pairs, or more pairs than possible, a share is outside 0 to 1, or noise is not
        positive.
    """
    noise = noise or ObjectNoise()
    _check_request(num_images, num_edges, noise)
    rng = np.random.default_rng(seed)
    R, p = _cameras(num_images, rng)
    drawn = np.exp(np.log(MEDIAN_INLIERS) + INLIER_SPREAD * rng.standard_normal(num_edges))
    inliers = -np.sort(-np.maximum(np.round(drawn), MIN_INLIERS).astype(np.int64))
    wrong = rng.random(num_edges) < _false_share(inliers, noise.hardness)
    # The pairs with most overlap are the true ones, and among these the inliers decrease with the overlap.
    pairs = _pairs_by_overlap(p, rng)
    num_true = int((~wrong).sum())
    relative, direction = _relative_poses(R, p, pairs[:num_true])
    wrong_pairs, wrong_relative, wrong_direction = _false_pairs(
        R, p, pairs[num_true:], num_edges - num_true, noise.coherent_share, rng
    )
    edges = np.concatenate([pairs[:num_true], wrong_pairs])
    relative = np.concatenate([relative, wrong_relative])
    direction = np.concatenate([direction, wrong_direction])
    counts = np.concatenate([inliers[~wrong], rng.permutation(inliers[wrong])])
    relative, direction, rotation_sigma, direction_sigma = _with_noise(relative, direction, counts, noise, rng)
    order = rng.permutation(num_edges)
    precisions = np.stack([rotation_sigma] * 3 + [direction_sigma] * 2, axis=1)[order] ** -2.0
    graph = ViewGraph(
        image_ids=np.arange(1, num_images + 1),
        edges=edges[order],
        cam2_from_cam1_rotations=so3.project(relative[order]),
        cam2_in_cam1_directions=normalized(direction[order]),
        num_inliers=counts[order],
        edge_information=precisions[:, :, None] * np.eye(5),
    )
    return SyntheticScene(graph, R, p, np.arange(num_edges)[order] >= num_true)


def _check_request(num_images: int, num_edges: int, noise: ObjectNoise) -> None:
    """Raise `OptionError` for numbers and noise that `object_scene` cannot simulate."""
    num_pairs = num_images * (num_images - 1) // 2
    if num_images < 8 or not 4 * num_images <= num_edges <= num_pairs:
        raise OptionError(
            f"object_scene: {num_edges} pairs of {num_images} images; use at least 8 images, and from "
            f"{4 * num_images} to {num_pairs} pairs"
        )
    if not (noise.rotation_deg > 0 and noise.direction_deg > 0):
        raise OptionError("object_scene: rotation_deg and direction_deg must be positive")
    if not (0 <= noise.hardness <= 1 and 0 <= noise.coherent_share <= 1):
        raise OptionError("object_scene: hardness and coherent_share must lie between 0 and 1")


def _with_noise(
    relative: Array, direction: Array, inliers: IntArray, noise: ObjectNoise, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Relative rotations and directions with noise, and its standard deviations in radians, (m,) each."""
    num_edges = len(relative)
    # The precision of a pair does not depend on whether it is true.
    fewness = np.sqrt(MEDIAN_INLIERS / rng.permutation(inliers)) * np.exp(0.3 * rng.standard_normal(num_edges))
    rotation_sigma, direction_sigma = (
        np.radians(noise.rotation_deg) * fewness,
        np.radians(noise.direction_deg) * fewness,
    )
    relative = so3.exp((1.0 + noise.focal_error) * so3.log(relative))
    relative = so3.exp(rotation_sigma[:, None] * rng.standard_normal((num_edges, 3))) @ relative
    direction = np.einsum(
        "kab,kb->ka", so3.exp(direction_sigma[:, None] * rng.standard_normal((num_edges, 3))), direction
    )
    return relative, direction, rotation_sigma, direction_sigma


def symmetric_object_scene(
    num_images: int, num_sides: int, unique_share: float = 0.3, noise: ObjectNoise | None = None, seed: int = 0
) -> SyntheticScene:
    """Simulate the viewing graph of cameras on a ring around an object with equal sides on an asymmetric ground.

    The matches of each pair of images are those of the object rotated by the number of sides for which the two views
    have most matches; the ground adds matches only where that number is 0.

    Parameters
    ----------
    num_images : int
        8 or more.
    num_sides : int
        Number of equal sides, 2 or more.
    unique_share : float
        Ratio of the matches on the ground to those on the object.
    noise : ObjectNoise, optional
        `hardness`, `coherent_share` and `focal_error` are not used.
    seed : int

    Returns
    -------
    SyntheticScene
        `outlier` marks pairs that match different sides.

    Raises
    ------
    OptionError
        There are too few images or sides, or a share or noise is negative.
    """
    noise = noise or ObjectNoise()
    if num_images < 8 or num_sides < 2 or unique_share < 0:
        raise OptionError(
            f"symmetric_object_scene: {num_images} images, {num_sides} sides and a unique share of {unique_share}; use"
            " at least 8 images, 2 sides and a share of 0"
        )
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * np.arange(num_images) / num_images
    p = 4.0 * np.stack([np.cos(turn), np.sin(turn), np.full(num_images, 0.3)], axis=1)
    p += 0.05 * rng.standard_normal((num_images, 3))
    R = look_at(p, 0.05 * rng.standard_normal((num_images, 3)))
    i, j = np.triu_indices(num_images, 1)
    side = 2.0 * np.pi * np.arange(num_sides) / num_sides
    apart = (turn[j] - turn[i] + side[:, None] + np.pi) % (2.0 * np.pi) - np.pi
    matches = SIDE_INLIERS * np.exp(-np.square(apart / SIDE_WIDTH) + 0.3 * rng.standard_normal(apart.shape))
    matches[0] *= 1.0 + unique_share
    best = matches.argmax(axis=0)
    counts = np.round(matches.max(axis=0)).astype(np.int64)
    seen = counts >= MIN_INLIERS
    i, j, best, counts = i[seen], j[seen], best[seen], counts[seen]
    turned = so3.exp(np.stack([np.zeros(len(side)), np.zeros(len(side)), side], axis=1))[best]
    R_seen, p_seen = R[j] @ np.swapaxes(turned, 1, 2), np.einsum("kab,kb->ka", turned, p[j])
    fewness = np.sqrt(MEDIAN_INLIERS / counts)
    sigmas = [np.radians(noise.rotation_deg) * fewness, np.radians(noise.direction_deg) * fewness]
    tilts = [so3.exp(s[:, None] * rng.standard_normal((len(i), 3))) for s in sigmas]
    direction = np.einsum("kab,kbc,kc->ka", tilts[1], R[i], normalized(p_seen - p[i]))
    graph = ViewGraph(
        image_ids=np.arange(1, num_images + 1),
        edges=np.stack([i, j], axis=1),
        cam2_from_cam1_rotations=so3.project(tilts[0] @ R_seen @ np.swapaxes(R[i], 1, 2)),
        cam2_in_cam1_directions=normalized(direction),
        num_inliers=counts,
        edge_information=(np.stack([sigmas[0]] * 3 + [sigmas[1]] * 2, axis=1) ** -2.0)[:, :, None] * np.eye(5),
    )
    return SyntheticScene(graph, R, p, best != 0)


def _cameras(num_images: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rotations and centres of cameras on one to three rings, in random order."""
    heights = np.radians([20.0, 45.0, -5.0])[: int(rng.integers(1, 4))]
    ring = np.arange(num_images) % len(heights)
    turn = 2.0 * np.pi * (np.arange(num_images) + 0.4 * rng.standard_normal(num_images)) / num_images
    height = heights[ring] + 0.05 * rng.standard_normal(num_images)
    distance = 4.0 * (1.0 + 0.1 * rng.standard_normal(num_images))
    flat = np.stack([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)], axis=1)
    p = (distance[:, None] * flat)[rng.permutation(num_images)]
    R = look_at(p, 0.2 * rng.standard_normal((num_images, 3)))
    return so3.exp(0.05 * rng.standard_normal((num_images, 3))) @ R, p


def _false_share(inliers: IntArray, hardness: float) -> Array:
    """Share of false pairs among those with the given numbers of inliers."""
    starts, low, high = np.array(FALSE_SHARES).T
    row = np.searchsorted(starts, inliers, side="right") - 1
    return np.asarray(low[row] + hardness * (high[row] - low[row]))


def _pairs_by_overlap(p: Array, rng: np.random.Generator) -> IntArray:
    """All pairs (k, 2) in the order of decreasing overlap: by the angle between the views, with random noise."""
    i, j = np.triu_indices(len(p), 1)
    looks = normalized(p)
    angle = np.arccos(np.clip(np.einsum("ka,ka->k", looks[i], looks[j]), -1.0, 1.0))
    order = np.argsort(angle * np.exp(0.25 * rng.standard_normal(len(i))), kind="stable")
    return np.stack([i[order], j[order]], axis=1).astype(np.int64)


def _relative_poses(R: Array, p: Array, edges: IntArray) -> tuple[Array, Array]:
    i, j = edges.T
    return R[j] @ np.swapaxes(R[i], 1, 2), normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))


def _false_pairs(
    R: Array, p: Array, pairs: IntArray, count: int, coherent_share: float, rng: np.random.Generator
) -> tuple[IntArray, Array, Array]:
    """Choose false pairs among pairs without overlap, and give them coherent or random relative poses.

    In a coherent false pair the second camera is rotated about the vertical axis of the object, as if another side were
    this one, by one of two angles: half a turn or a random one.
    """
    turns = np.array([np.pi, rng.uniform(0.3, 0.7) * np.pi])
    moved = [so3.exp(np.array([[0.0, 0.0, a]]))[0] for a in turns]
    p_moved = np.stack([p @ Q.T for Q in moved])
    R_moved = np.stack([R @ Q.T for Q in moved])
    looks = normalized(p)
    i, j = pairs.T
    closeness = np.stack([np.einsum("ka,ka->k", looks[i], normalized(q)[j]) for q in p_moved])
    which = closeness.argmax(axis=0)
    alike = np.flatnonzero(closeness.max(axis=0) > np.cos(MAX_VIEW_ANGLE / 2.0))
    alike = rng.permutation(alike)[: round(coherent_share * count)]
    others = rng.permutation(np.setdiff1d(np.arange(len(pairs)), alike))[: count - len(alike)]
    rows = np.concatenate([alike, others])
    i, j, kind = pairs[rows, 0], pairs[rows, 1], which[rows]
    relative = R_moved[kind, j] @ np.swapaxes(R[i], 1, 2)
    direction = normalized(np.einsum("kab,kb->ka", R[i], p_moved[kind, j] - p[i]))
    # Random matches are of views that look alike: measured false pairs had relative rotations of 10 to 60 degrees.
    chance = len(alike) + np.arange(len(others))
    axes = normalized(rng.standard_normal((len(others), 3)))
    relative[chance] = so3.exp(axes * np.radians(rng.uniform(5.0, 60.0, (len(others), 1))))
    direction[chance] = normalized(rng.standard_normal((len(others), 3)) * np.array([1.0, 1.0, 0.4]))
    return pairs[rows], relative, direction
