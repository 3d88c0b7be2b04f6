"""How well the adjusted cameras are known: their covariance under the noise of the keypoints.

One noisy keypoint enters every pair and triplet that matched it, so that residuals which share it are correlated; to
take them for independent makes a camera seen in many pairs look far too certain. Here draws of keypoint noise go
through all residuals that they touch, and through the normal equations at the minimum, to the cameras: no inverse, no
pairs of residuals.

To first order, the minimum of ``sum rho(r)`` moves by ``-(E psi' sum J J^T)^-1 sum psi(r) J``. Of ``psi(r) / E psi'``
the part linear in the noise is r itself, shared by all residuals of a keypoint; the rest, of variance
``E psi^2 / (E psi')^2 - sigma^2``, is taken as each residual's own (of odd functions of two normal numbers with
correlation c, all but the linear part have covariances of order c^3).
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import AdjustmentResult, Cameras, edge_chain, triplet_chain
from colmap_vg.epipolar.depth_agreement import depth_derivatives_by_block, depth_equations
from colmap_vg.epipolar.normal_system import CameraTerms, NormalSystem
from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.geometry import so3
from colmap_vg.linear.robust_losses import MAD_TO_SIGMA, cauchy_weight
from colmap_vg.scene.components import components_by_size
from colmap_vg.two_view.sampson import derivatives_by_block, normal_equations
from colmap_vg.two_view.segments import segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

NUM_DRAWS = 128
"""Of noise: variances come out within an eighth of their value."""
DRAWS_AT_ONCE = 32
_UNWEIGHTED = 1e9  # pixels; a loss of this scale weighs all residuals alike


@dataclass(frozen=True, eq=False)
class CameraCovariances:
    """Covariances after the similarity that best aligns all positions has been taken out.

    Attributes
    ----------
    positions : (n, 3, 3) array
        Of the centres, in the cameras' world frame and unit.
    rotations : (n, 3, 3) array
        Of small turns w of each camera in its own frame, ``R <- exp(w) R``, squared radians.
    sigma_px : float
        Standard deviation of a keypoint in each axis, pixels.
    """

    positions: Array
    rotations: Array
    sigma_px: float


def camera_covariances(
    problem: EpipolarProblem, found: AdjustmentResult, *, seed: int = 0, num_draws: int = NUM_DRAWS
) -> CameraCovariances:
    """Covariances of adjusted cameras.

    Parameters
    ----------
    problem : EpipolarProblem
        As it was adjusted. Without keypoints of the matches, these are taken for independent.
    found : AdjustmentResult
    seed : int
        Of the draws.
    num_draws : int

    Returns
    -------
    CameraCovariances
    """
    problem = problem.without(found.reversed_edges) if found.reversed_edges.any() else problem
    problem = replace(problem, free_focals=problem.free_focals & ~found.lost_focals)
    cameras = Cameras(found.cam_from_world_rotations, found.projection_centers, np.log(found.focal_scales))
    kinds = _residuals(problem, cameras)
    free = np.flatnonzero(problem.free_focals)
    system = NormalSystem(
        problem.num_images, [k.terms.images for k in kinds], problem.camera_idx, free, len(problem.focal_lengths)
    )
    factor = system.factor([kind.terms for kind in kinds])
    num_parameters = 6 * problem.num_images - 7 + len(free)
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
    """Residuals of one kind with s rays each, in segments that the same cameras see.

    Residuals (k,) in pixels; derivatives (k, b) by the segment's parameters and log focals, and (s, k, 3) by the
    noise of its keypoints; keypoints (s, k) counted through; derivatives (q, b', 6 s) of the parameters by the cameras.
    """

    r: Array
    by_pose: Array
    by_noise: Array
    keypoints: IntArray
    offsets: IntArray
    chain: Array
    terms: CameraTerms

    def moved(self, noise: Array) -> Array:
        """Changes of the residuals (k, draws) under noise (keypoints, 3 draws) of the keypoints."""
        total = np.zeros((len(self.r), noise.shape[1] // 3))
        for keypoints, along in zip(self.keypoints, self.by_noise, strict=True):
            total += np.einsum("ka,kad->kd", along, noise[keypoints].reshape(len(keypoints), 3, -1))
        return total

    def pull(self, dr: Array) -> tuple[Array, Array]:
        """Gradients by poses (q, 6 s, draws) and log focals (q, s, draws) that changes (k, draws) of residuals make."""
        rows = np.arange(len(self.r))
        q, b, wide = self.chain.shape
        by_parameter = np.stack(
            [
                sp.csr_array((column, rows, self.offsets), shape=(q, len(rows))) @ dr
                for column in np.ascontiguousarray(self.by_pose.T)
            ],
            axis=1,
        )
        by_focal = by_parameter[:, b:] if by_parameter.shape[1] > b else np.zeros((q, wide // 6, dr.shape[1]))
        return np.swapaxes(self.chain, 1, 2) @ by_parameter[:, :b], by_focal


def _residuals(problem: EpipolarProblem, cameras: Cameras) -> list[_Residuals]:
    """Residuals of pairs and, where there are any, of triplets."""
    with_focals, numbers = bool(problem.free_focals.any()), _numbered_keypoints(problem)
    edges, (R, d, length) = problem.edges, cameras.relative(problem.edges)
    matches = problem.matches(cameras.log_scales)
    at = normal_equations(matches, R, d, np.full(len(edges), _UNWEIGHTED), with_focals=with_focals)
    chain = edge_chain(cameras.rotations[edges[:, 0]], R, d, length)
    pairs = [part for *_, part in derivatives_by_block(matches, R, d, with_focals=with_focals)]
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
        images, rays = problem.triplets.images, problem.triplet_rays(problem.triplets, cameras.log_scales)
        poses = cameras.about_middle(images)
        depth = depth_equations(rays, poses, _UNWEIGHTED, with_focals=with_focals)
        chain = triplet_chain(cameras.rotations[images[:, 1]], poses)
        tracks = [part for *_, part in depth_derivatives_by_block(rays, poses, with_focals=with_focals)]
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
    """Numbers from 0 of the keypoints in all images together: of pairs (2, k), and of triplets (3, k)."""
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
    """Deviations in pixels: of a keypoint in each axis, and of what the loss adds to each residual by itself."""
    r = np.concatenate([kind.r for kind in kinds])
    numbers = np.concatenate([kind.keypoints.ravel() for kind in kinds])
    count, links = (
        int(numbers.max()) + 1,
        [kind.keypoints[[0, s]] for kind in kinds for s in range(1, len(kind.keypoints))],
    )
    joined = np.concatenate(links, axis=1)
    num_points = int(components_by_size(count, joined.T).max()) + 1
    # Two numbers a keypoint, of which a point takes three and the cameras theirs.
    num_constraints = 2 * count - 3 * num_points
    freedom = num_constraints / max(num_constraints - num_parameters, 1)
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(r))) * np.sqrt(freedom)
    w = cauchy_weight(np.square(r / scale_px))
    slope, square = float(np.mean(w * (2.0 * w - 1.0))), float(np.mean(np.square(w * r))) * freedom
    return sigma, float(np.sqrt(max(square / slope**2 - sigma**2, 0.0)))


def _without_gauge(cameras: Cameras, step: Array) -> tuple[Array, Array]:
    """Turns and shifts (n, 3, draws) after the best small similarity of the shifts has been taken out."""
    turns, shifts = step[:, :3], step[:, 3:]
    p = cameras.centers - cameras.centers.mean(axis=0)
    shifts = shifts - shifts.mean(axis=0)
    # Small similarity: x -> omega x p + s p; a world turned by omega turns cameras by -R omega.
    basis = np.concatenate([-so3.hat(p), p[:, :, None]], axis=2).reshape(-1, 4)
    n, _, draws = shifts.shape
    similarity = np.linalg.lstsq(basis, shifts.reshape(-1, draws), rcond=None)[0]
    turned = np.einsum("nab,bd->nad", cameras.rotations, similarity[:3])
    return turns + turned, shifts - (basis @ similarity).reshape(n, 3, draws)
