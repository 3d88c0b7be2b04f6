"""Covariances of adjusted cameras under the noise of the keypoints, by Monte Carlo propagation.

The noise of a keypoint affects every pair and triplet that matches it, so that residuals sharing it are correlated;
under the assumption of independence, a camera in many pairs would seem far too certain. Here samples of keypoint noise
are propagated through all residuals that they affect and through the normal equations at the minimum to the cameras,
which needs neither an inverse nor covariances of residuals.

To first order, the minimum of ``sum rho(r)`` moves by ``-(E psi' sum J J^T)^-1 sum psi(r) J``. The part of
``psi(r) / E psi'`` that is linear in the noise is r itself, shared by all residuals of a keypoint. The remainder, of
variance ``E psi^2 / (E psi')^2 - sigma^2``, is treated as independent between residuals (for odd functions of two
normal variables with correlation c, all but the linear part have covariances of order c^3).
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import AdjustmentResult, edge_chain, normal_system, triplet_chain
from colmap_vg.epipolar.cameras import Cameras
from colmap_vg.epipolar.depth_agreement import depth_derivatives_by_block, depth_equations
from colmap_vg.epipolar.normal_system import CameraTerms
from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.geometry import so3
from colmap_vg.linear.robust_losses import MAD_TO_SIGMA, cauchy_weight
from colmap_vg.scene.components import components_by_size
from colmap_vg.two_view.sampson import derivatives_by_block, normal_equations
from colmap_vg.two_view.segments import segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

NUM_DRAWS = 128
"""Number of noise samples, from which variances are estimated to within an eighth."""
DRAWS_AT_ONCE = 32
"""Number of noise samples that are propagated together."""
_UNWEIGHTED = 1e9  # pixels; a loss of this scale gives all residuals the same weight


@dataclass(frozen=True, eq=False)
class CameraCovariances:
    """Covariances of poses after the similarity that best aligns all positions is removed.

    Attributes
    ----------
    positions : (n, 3, 3) array
        Covariances of the centres, in the world frame and squared unit of the cameras.
    rotations : (n, 3, 3) array
        Covariances of small rotations w of each camera in its own frame, ``R <- exp(w) R``, squared radians.
    sigma_px : float
        Standard deviation of a keypoint per axis, pixels.
    """

    positions: Array
    rotations: Array
    sigma_px: float


def camera_covariances(
    problem: EpipolarProblem, found: AdjustmentResult, *, seed: int = 0, num_draws: int = NUM_DRAWS
) -> CameraCovariances:
    """Estimate the covariances of adjusted cameras.

    Parameters
    ----------
    problem : EpipolarProblem
        The adjusted problem. Without keypoint indices, matches are treated as independent.
    found : AdjustmentResult
        Result of the adjustment.
    seed : int
        Random seed of the noise samples.
    num_draws : int
        Number of noise samples.

    Returns
    -------
    CameraCovariances
    """
    problem = problem.without(found.reversed_edges) if found.reversed_edges.any() else problem
    problem = replace(problem, free_focals=problem.free_focals & ~found.lost_focals)
    cameras = found.cameras
    kinds = _residuals(problem, cameras)
    system = normal_system(problem)
    factor = system.factor([kind.terms for kind in kinds])
    num_parameters = 6 * problem.num_images - 7 + system.num_lens_unknowns
    sigma, own = _noise(kinds, found.scale_px, num_parameters)
    rng = np.random.default_rng(seed)
    num_keypoints = 1 + max(int(kind.keypoints.max(initial=-1)) for kind in kinds)
    positions, rotations = np.zeros((2, problem.num_images, 3, 3))
    for start in range(0, num_draws, DRAWS_AT_ONCE):
        draws = min(DRAWS_AT_ONCE, num_draws - start)
        noise = sigma * rng.standard_normal((num_keypoints, 3 * draws))
        pulls = [k.pull(k.moved(noise) + own * rng.standard_normal((len(k.r), draws))) for k in kinds]
        step = factor.solve(system.summed(*zip(*pulls, strict=True)))[: 6 * problem.num_images]
        turns, shifts = _without_gauge(cameras, step.reshape(problem.num_images, 6, draws))
        positions += np.einsum("nad,nbd->nab", shifts, shifts)
        rotations += np.einsum("nad,nbd->nab", turns, turns)
    return CameraCovariances(positions / num_draws, rotations / num_draws, sigma)


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of pairs (s = 2 rays each) or triplets (s = 3), in segments with the same cameras.

    Residuals (k,) in pixels; derivatives (k, b) by the segment's parameters and lenses, and (s, k, 3) by the
    noise of its keypoints; keypoint numbers (s, k); derivatives (q, b', 6 s) of the parameters by the cameras.
    """

    r: Array
    by_pose: Array
    by_noise: Array
    keypoints: IntArray
    offsets: IntArray
    chain: Array
    terms: CameraTerms

    def moved(self, noise: Array) -> Array:
        """Changes (k, draws) of the residuals caused by noise (keypoints, 3 draws) of the keypoints."""
        total = np.zeros((len(self.r), noise.shape[1] // 3))
        for keypoints, along in zip(self.keypoints, self.by_noise, strict=True):
            total += np.einsum("ka,kad->kd", along, noise[keypoints].reshape(len(keypoints), 3, -1))
        return total

    def pull(self, dr: Array) -> tuple[Array, Array]:
        """Gradients by poses (q, 6 s, draws) and lenses (q, t, draws) for changes (k, draws) of the residuals."""
        rows = np.arange(len(self.r))
        q, b, _ = self.chain.shape
        by_parameter = np.stack(
            [
                sp.csr_array((column, rows, self.offsets), shape=(q, len(rows))) @ dr
                for column in np.ascontiguousarray(self.by_pose.T)
            ],
            axis=1,
        )
        return np.swapaxes(self.chain, 1, 2) @ by_parameter[:, :b], by_parameter[:, b:]


def _residuals(problem: EpipolarProblem, cameras: Cameras) -> list[_Residuals]:
    """Residuals of the pairs and, if there are any, of the triplets."""
    edges, numbers, (R, d, length) = problem.edges, _numbered_keypoints(problem), cameras.relative(problem.edges)
    matches = problem.matches(cameras.lenses)
    at = normal_equations(matches, R, d, np.full(len(edges), _UNWEIGHTED))
    chain = edge_chain(cameras.rotations[edges[:, 0]], R, d, length)
    pairs = [part for *_, part in derivatives_by_block(matches, R, d)]
    kinds = [
        _Residuals(
            np.concatenate([p.r for p in pairs]),
            np.concatenate([p.by_pose.T for p in pairs]),
            np.concatenate([np.stack([p.by_ray1.T, p.by_ray2.T]) for p in pairs], axis=1),
            numbers[0],
            problem.offsets,
            chain,
            CameraTerms.chained(edges, at.costs, at.gradients, at.hessians, chain),
        )
    ]
    if problem.triplets is not None:
        images, rays = problem.triplets.images, problem.triplet_rays(problem.triplets, cameras.lenses)
        poses = cameras.about_middle(images)
        depth = depth_equations(rays, poses, _UNWEIGHTED)
        chain = triplet_chain(cameras.rotations[images[:, 1]], poses)
        tracks = [part for *_, part in depth_derivatives_by_block(rays, poses)]
        kinds.append(
            _Residuals(
                np.concatenate([t.r for t in tracks]),
                np.concatenate([t.by_pose.T for t in tracks]),
                np.concatenate([np.swapaxes(t.by_rays, 1, 2) for t in tracks], axis=1),
                numbers[1],
                problem.triplets.offsets,
                chain,
                CameraTerms.chained(images, depth.costs, depth.gradients, depth.hessians, chain),
            )
        )
    return kinds


def _numbered_keypoints(problem: EpipolarProblem) -> list[IntArray]:
    """Consecutive numbers of the keypoints of all images: for pairs (2, k), and for triplets (3, k)."""
    if problem.keypoints1 is None or problem.keypoints2 is None:
        return [np.arange(2 * len(problem.bearings1)).reshape(2, -1)]
    pairs = np.stack([problem.keypoints1, problem.keypoints2]).astype(np.int64)
    kinds = [(pairs, problem.edges, problem.offsets)]
    if problem.triplets is not None:
        kinds.append((problem.triplets.keypoints, problem.triplets.images, problem.triplets.offsets))
    wide = 1 + max(int(keypoints.max(initial=0)) for keypoints, *_ in kinds)
    keys = [
        images[segment_of_rows(offsets)].T.astype(np.int64) * wide + keypoints for keypoints, images, offsets in kinds
    ]
    _, numbers = np.unique(np.concatenate([key.ravel() for key in keys]), return_inverse=True)
    parts = np.split(numbers.ravel(), np.cumsum([key.size for key in keys])[:-1])
    return [part.reshape(key.shape) for part, key in zip(parts, keys, strict=True)]


def _noise(kinds: list[_Residuals], scale_px: float, num_parameters: int) -> tuple[float, float]:
    """Standard deviations in pixels: of a keypoint per axis, and of the independent part that the loss adds."""
    r = np.concatenate([kind.r for kind in kinds])
    numbers = np.concatenate([kind.keypoints.ravel() for kind in kinds])
    count, links = (
        int(numbers.max()) + 1,
        [kind.keypoints[[0, s]] for kind in kinds for s in range(1, len(kind.keypoints))],
    )
    joined = np.concatenate(links, axis=1)
    num_points = int(components_by_size(count, joined.T).max()) + 1
    # Two coordinates per keypoint, minus three per point; the cameras' parameters are subtracted below.
    num_constraints = 2 * count - 3 * num_points
    freedom = num_constraints / max(num_constraints - num_parameters, 1)
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(r))) * np.sqrt(freedom)
    w = cauchy_weight(np.square(r / scale_px))
    slope, square = float(np.mean(w * (2.0 * w - 1.0))), float(np.mean(np.square(w * r))) * freedom
    return sigma, float(np.sqrt(max(square / slope**2 - sigma**2, 0.0)))


def _without_gauge(cameras: Cameras, step: Array) -> tuple[Array, Array]:
    """Rotations and shifts (n, 3, draws) of a step after the best small similarity of the shifts is removed."""
    turns, shifts = step[:, :3], step[:, 3:]
    p = cameras.centers - cameras.centers.mean(axis=0)
    shifts = shifts - shifts.mean(axis=0)
    # Small similarity: x -> omega x p + s p; rotating the world by omega rotates cameras by -R omega.
    basis = np.concatenate([-so3.hat(p), p[:, :, None]], axis=2).reshape(-1, 4)
    n, _, draws = shifts.shape
    similarity = np.linalg.lstsq(basis, shifts.reshape(-1, draws), rcond=None)[0]
    turned = np.einsum("nab,bd->nad", cameras.rotations, similarity[:3])
    return turns + turned, shifts - (basis @ similarity).reshape(n, 3, draws)
