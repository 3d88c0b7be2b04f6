"""Refine averaged rotations by measured directions of gravity, some of which are wrong or upside down.

With the relative rotations ``R_ij`` of the edges and the unit vectors ``g_i`` downwards in the cameras, the cost is

    sum_ij rho(|log(R_j^T R_ij R_i)|^2 / s_ij^2) + sum_i |R_i^T g_i - d|^2 / s_g^2,

where d is the world's downward direction, the robust mean of ``R_i^T g_i``. Both noise levels come from the residuals
of the averaged rotations: what these owe to the edges' noise is taken off that of gravity.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.laplacian import LaplacianSystem
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, MAD_TO_SIGMA, cauchy_weight
from colmap_vg.linear.solvers import factorize

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_MEASURED, MIN_SHARE_AGREEING = 3, 0.5
"""Minimum number of images with a direction of gravity, and share of those that agree on the world's."""
AGREEMENT_DEG = 15.0
"""Angle within which directions vote for one of the world."""
MAX_SIGMAS = 4.0
"""Residual of a direction, in standard deviations, above which it is wrong."""
MIN_SIGMA = np.radians(0.2)
"""Minimum standard deviation of gravity, radians: that of a good inclinometer, and the least of edges."""
NUM_STEPS, NUM_PROBES = 8, 16
"""Number of Gauss-Newton steps, and of random right sides that estimate the variance of averaged rotations."""
MAX_WEIGHT = 10.0
"""Maximum weight of an edge over the median one."""


@dataclass(frozen=True, eq=False)
class GravityRefinement:
    """Rotations refined by gravity.

    Attributes
    ----------
    rotations : (n, 3, 3) array
        cam_from_world; those given where gravity is not used.
    used : (n,) bool array
        Images whose direction of gravity was used.
    flipped : (n,) bool array
        Images whose direction was used upside down.
    """

    rotations: Array
    used: BoolArray
    flipped: BoolArray


def refine_by_gravity(
    num_images: int, edges: IntArray, relative: Array, weights: Array, rotations: Array, gravities: Array, seed: int = 0
) -> GravityRefinement:
    """Refine averaged rotations by directions of gravity.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Of a connected graph.
    relative : (m, 3, 3) array
        cam2_from_cam1 rotations.
    weights : (m,) array
        Precisions of the edges, up to a factor.
    rotations : (n, 3, 3) array
        cam_from_world.
    gravities : (n, 3) array
        Unit vectors downwards in the cameras' frames; NaN where none was measured.
    seed : int

    Returns
    -------
    GravityRefinement
    """
    nothing = np.zeros(num_images, dtype=bool)
    measured = np.asarray(np.isfinite(gravities).all(axis=1))
    known: Array = np.where(measured[:, None], gravities, 0.0)
    in_world: Array = np.einsum("kba,kb->ka", rotations, known)
    down = common_direction(in_world[measured]) if measured.sum() >= MIN_MEASURED else None
    if down is None:
        return GravityRefinement(rotations, nothing, nothing)
    flipped = np.asarray(measured & (np.einsum("ka,a->k", in_world, down) < 0.0))
    gravities = np.where(flipped[:, None], -gravities, gravities)
    in_world = np.where(flipped[:, None], -in_world, in_world)
    shares = np.minimum(weights / max(float(np.median(weights)), 1e-300), MAX_WEIGHT)
    noise = _edge_noise(num_images, edges, relative, shares, rotations)
    of_rotations = _rotation_variance(num_images, edges, shares / noise**2, seed)
    off = np.linalg.norm(np.cross(in_world, down), axis=1)
    near = measured & (off <= np.radians(AGREEMENT_DEG))
    # The two components of a deviation have a Rayleigh-distributed length, with median 1.1774 sigma.
    spread = (np.median(off[near]) / 1.1774) ** 2
    sigma = float(np.sqrt(max(spread - of_rotations, MIN_SIGMA**2)))
    used = near & (off <= MAX_SIGMAS * np.sqrt(max(spread, MIN_SIGMA**2)))
    refined = rotations.copy()
    for _ in range(NUM_STEPS):
        known = np.where(used[:, None], gravities, 0.0)
        step = _step(edges, relative, shares / noise**2, refined, known, down, sigma)
        refined = so3.project(refined @ so3.exp(step))
        if np.abs(step).max(initial=0.0) < 1e-9:
            break
    return GravityRefinement(refined, used, used & flipped)


def common_direction(directions: Array) -> Array | None:
    """The direction that most unit vectors (k, 3), k >= 1, agree with up to their sign; None if fewer than half do."""
    cosine = directions @ directions.T
    votes = (np.abs(cosine) >= np.cos(np.radians(AGREEMENT_DEG))).sum(axis=1)
    best = int(np.argmax(votes))
    agree = np.abs(cosine[best]) >= np.cos(np.radians(AGREEMENT_DEG))
    if agree.mean() < MIN_SHARE_AGREEING:
        return None
    signs = np.sign(cosine[best, agree])
    mean = (signs[:, None] * directions[agree]).sum(axis=0)
    # The majority is right side up.
    mean *= 1.0 if signs.sum() >= 0 else -1.0
    return np.asarray(mean / np.linalg.norm(mean))


def _edge_noise(num_images: int, edges: IntArray, relative: Array, shares: Array, rotations: Array) -> float:
    """Standard deviation of each component of an edge of weight one, radians."""
    residuals = _residuals(edges, relative, rotations) * np.sqrt(shares)[:, None]
    # Averaging takes three unknowns of each image but one.
    left = max(1.0 - (num_images - 1) / max(len(edges), 1), 0.1)
    return max(float(MAD_TO_SIGMA * np.median(np.abs(residuals)) / np.sqrt(left)), float(MIN_SIGMA))


def _residuals(edges: IntArray, relative: Array, rotations: Array) -> Array:
    """Rotation vectors (m, 3) of ``R_j^T R_ij R_i``, in the world's frame."""
    i, j = edges.T
    return so3.log(np.swapaxes(rotations[j], 1, 2) @ relative @ rotations[i])


def _rotation_variance(num_images: int, edges: IntArray, weights: Array, seed: int) -> float:
    """Mean variance of a component of averaged rotations, squared radians, relative to their common rotation."""
    factor = LaplacianSystem(num_images, edges).factor(weights)
    probes = np.random.default_rng(seed).choice([-1.0, 1.0], size=(num_images, NUM_PROBES))
    probes -= probes.mean(axis=0)
    return float(np.mean(np.sum(probes * factor.solve(probes), axis=0)) / num_images)


def _step(
    edges: IntArray,
    relative: Array,
    precisions: Array,
    rotations: Array,
    gravities: Array,
    down: Array,
    sigma: float,
) -> Array:
    """Gauss-Newton step (n, 3) of ``R <- R exp(w)``; gravity is zero where it is not used."""
    num_images, residuals = len(rotations), _residuals(edges, relative, rotations)
    squared = precisions * np.sum(residuals**2, axis=1) / 3.0
    weights = precisions * cauchy_weight(squared / EFFICIENT_CAUCHY**2)
    block = weights[:, None, None] * np.eye(3)
    in_world = np.einsum("kba,kb->ka", rotations, gravities)
    # exp(-w) u = u + u x w to first order, and shall be d.
    H = so3.hat(in_world)
    own = np.swapaxes(H, 1, 2) @ H / sigma**2
    damping = 1e-9 * float(weights.sum()) / num_images * np.eye(3)
    matrix = BlockPattern(num_images, edges, 3).assemble(block, block, -block, own + damping)
    pull = weights[:, None] * residuals
    right = sum_at_nodes(num_images, edges[:, 1], pull) - sum_at_nodes(num_images, edges[:, 0], pull)
    used = np.linalg.norm(gravities, axis=1) > 0.0
    lacking = np.where(used[:, None], down - in_world, 0.0)
    right += np.einsum("kba,kb->ka", H, lacking) / sigma**2
    return np.asarray(factorize(matrix).solve(right.ravel()).reshape(-1, 3))
