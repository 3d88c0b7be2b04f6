"""Poses of rigs from those of their images: frames and sensors averaged robustly, scale from known baselines.

With sensor s in its rig and rig frame f in the world, image i has ``R_i = S_s F_f`` and ``C_i = C_f + F_f^T c_s``,
where ``c_s`` is the sensor's centre in the rig. Rotations are averaged in turn (Weiszfeld's algorithm on chords), then
all centres solve one linear problem with reweighting: unknown are ``C_f``, the ``c_s`` of sensors without a known pose,
and the factor on the known ``c_s``, which is the inverse of the scale.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import sum_at_nodes
from colmap_vg.linear.solvers import factorize
from colmap_vg.scene.rigs import RigPoses, Rigs
from colmap_vg.scene.solution import PoseSolution

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

NUM_TURNS = 20
"""Maximum number of times that frames and sensors are averaged in turn; two suffice where frames see all sensors."""
NUM_WEISZFELD, MIN_CHORD = 10, 1e-6
"""Number of reweightings of a rotation average, and minimum distance by which a weight is divided."""
NUM_REWEIGHTED = 20
"""Number of reweightings of the centres."""
MIN_DISTANCE = 1e-6
"""Minimum residual by which a weight is divided, as a share of the extent of the cameras."""
CONVERGED_RAD = 1e-9
MIN_SCALE_SIGMAS = 3.0
"""Standard deviations of the scale from zero, below which the rig's baselines do not tell it."""


def rig_poses_of_component(rigs: Rigs, solution: PoseSolution, component: int) -> RigPoses:
    """Average the poses of a component's images to those of frames and sensors.

    A frame belongs to the component that has most of its images, the larger one of two with as many.

    Parameters
    ----------
    rigs : Rigs
    solution : PoseSolution
    component : int

    Returns
    -------
    RigPoses
    """
    inside = np.flatnonzero(solution.component >= 0)
    count = int(solution.component.max(initial=0)) + 1
    place = rigs.frame_idx[inside] * count + solution.component[inside]
    votes = np.bincount(place, minlength=rigs.num_frames * count).reshape(-1, count)
    own = (np.argmax(votes, axis=1) == component) & (votes[:, component] > 0)
    solved = (solution.component == component) & own[rigs.frame_idx]
    return average_rig_poses(rigs, solved, solution.cam_from_world_rotations, solution.projection_centers)


def average_rig_poses(rigs: Rigs, solved: BoolArray, rotations: Array, centers: Array) -> RigPoses:
    """Average the poses of images to those of frames and sensors.

    Parameters
    ----------
    rigs : Rigs
    solved : (n,) bool array
        Images with a pose.
    rotations : (n, 3, 3) array
        cam_from_world.
    centers : (n, 3) array
        Projection centres, in one frame.

    Returns
    -------
    RigPoses
    """
    rows = np.flatnonzero(solved)
    frame, sensor = rigs.frame_idx[rows], rigs.sensor_idx[rows]
    F, S, placed = _averaged_rotations(rigs, frame, sensor, rotations[rows])
    usable = placed[sensor] & np.isfinite(F[frame]).all(axis=(1, 2))
    rows, frame, sensor = rows[usable], frame[usable], sensor[usable]
    C, c, factor, certain = _averaged_centers(rigs, frame, sensor, F, centers[rows], placed)
    return RigPoses(F, C, S, c, 1.0 / factor, certain)


def _averaged_rotations(
    rigs: Rigs, frame: IntArray, sensor: IntArray, rotations: Array
) -> tuple[Array, Array, BoolArray]:
    """Rotations of frames and sensors, NaN where they have none, and the mask (s,) of the sensors that have one."""
    known = rigs.known
    F, S = np.full((rigs.num_frames, 3, 3), np.nan), np.where(known[:, None, None], rigs.rotations, np.nan)
    placed = known.copy()
    for _ in range(NUM_TURNS):
        before, own = S.copy(), placed[sensor]
        F = _medians(np.swapaxes(S[sensor[own]], 1, 2) @ rotations[own], frame[own], rigs.num_frames)
        in_frame = np.isfinite(F[frame]).all(axis=(1, 2))
        if known.all():
            break
        found = _medians(
            rotations[in_frame] @ np.swapaxes(F[frame[in_frame]], 1, 2), sensor[in_frame], rigs.num_sensors
        )
        S = np.where(known[:, None, None], S, found)
        was, placed = placed, known | np.isfinite(S).all(axis=(1, 2))
        if (was == placed).all() and so3.angle(np.swapaxes(before[placed], 1, 2) @ S[placed]).max() < CONVERGED_RAD:
            break
    return F, S, placed


def _medians(rotations: Array, group: IntArray, count: int) -> Array:
    """Geometric medians (count, 3, 3) of groups of rotations (k, 3, 3), by chords; NaN for empty groups."""
    filled = np.bincount(group, minlength=count) > 0
    weights, found = np.ones(len(rotations)), np.full((count, 3, 3), np.nan)
    for _ in range(NUM_WEISZFELD):
        sums = sum_at_nodes(count, group, weights[:, None, None] * rotations)
        found[filled] = so3.project(sums[filled])
        chords = np.linalg.norm(rotations - found[group], axis=(1, 2))
        weights = 1.0 / np.maximum(chords, MIN_CHORD)
    return found


def _averaged_centers(
    rigs: Rigs, frame: IntArray, sensor: IntArray, F: Array, centers: Array, placed: BoolArray
) -> tuple[Array, Array, float, bool]:
    """Centres of frames and of sensors, the factor on known baselines, and whether these tell it."""
    if len(frame) == 0:
        return np.full((rigs.num_frames, 3), np.nan), np.where(rigs.known[:, None], rigs.centers, np.nan), 1.0, False
    known, baselines = rigs.known, np.where(rigs.known[:, None], rigs.centers, 0.0)
    frames, frame_row = np.unique(frame, return_inverse=True)
    unknown = np.flatnonzero(~known & placed)
    column = np.full(rigs.num_sensors, -1)
    column[unknown] = np.arange(len(unknown))
    back = np.swapaxes(F[frame], 1, 2)
    along = np.einsum("kab,kb->ka", back, baselines[sensor])
    with_scale = bool(np.abs(along).max(initial=0.0) > 0.0)
    A = _design(frame_row, len(frames), column[sensor], len(unknown), back, along if with_scale else None)
    extent = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0))
    weights = np.ones(len(centers))
    # Sensors that are seen in one frame only, and the scale, may be loose: a tiny ridge keeps the matrix definite.
    ridge = sp.diags_array(np.full(A.shape[1], 1e-12))
    for _ in range(NUM_REWEIGHTED):
        weighted = sp.diags_array(np.repeat(weights, 3)) @ A
        normal = sp.csc_array(weighted.T @ A)
        factor = factorize(sp.csc_array(normal + ridge * normal.diagonal().max()))
        solution = factor.solve(weighted.T @ centers.ravel())
        residuals = np.linalg.norm((centers.ravel() - A @ solution).reshape(-1, 3), axis=1)
        weights = 1.0 / np.maximum(residuals, max(MIN_DISTANCE * extent, 1e-300))
    C, c = np.full((rigs.num_frames, 3), np.nan), np.full((rigs.num_sensors, 3), np.nan)
    C[frames] = solution[: 3 * len(frames)].reshape(-1, 3)
    c[unknown] = solution[3 * len(frames) : 3 * (len(frames) + len(unknown))].reshape(-1, 3)
    if not with_scale:
        c[known] = rigs.centers[known]
        return C, c, 1.0, False
    unit, sigma = float(solution[-1]), _scale_sigma(factor, A.shape[1], residuals, weights)
    certain = unit > MIN_SCALE_SIGMAS * sigma
    unit = max(unit, sigma, 1e-300)
    c[known] = unit * rigs.centers[known]
    return C, c, unit, certain


def _design(
    frame: IntArray, num_frames: int, column: IntArray, num_unknown: int, back: Array, along: Array | None
) -> sp.csr_array:
    """Matrix (3 k, 3 f + 3 u [+ 1]) of the centres by those of frames, of unknown sensors, and the factor."""
    k = len(frame)
    row = np.arange(3 * k).reshape(k, 3)
    parts = [(np.ones((k, 3)), row, 3 * frame[:, None] + np.arange(3))]
    own = column >= 0
    places = 3 * (num_frames + column[own, None, None]) + np.arange(3)
    parts.append(
        (back[own], np.broadcast_to(row[own, :, None], (own.sum(), 3, 3)), np.broadcast_to(places, (own.sum(), 3, 3)))
    )
    if along is not None:
        parts.append((along, row, np.full((k, 3), 3 * (num_frames + num_unknown))))
    values, rows, columns = (np.concatenate([np.ravel(part[place]) for part in parts]) for place in range(3))
    width = 3 * (num_frames + num_unknown) + (along is not None)
    return sp.csr_array((values, (rows, columns)), shape=(3 * k, width))


def _scale_sigma(factor: object, size: int, residuals: Array, weights: Array) -> float:
    """Standard deviation of the factor on known baselines, the last unknown."""
    unit = np.zeros(size)
    unit[-1] = 1.0
    variance = float(factor.solve(unit)[-1])  # type: ignore[attr-defined]
    # Weighted residuals have variance weight * residual^2 on average, in three coordinates each.
    return float(np.sqrt(max(variance, 0.0) * np.mean(weights * residuals**2) / 3.0))
