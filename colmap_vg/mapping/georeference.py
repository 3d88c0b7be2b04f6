"""Georeference finished models: align them to measured positions, and adjust them to keypoints and positions."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.geometry.robust_similarity import AlignedPositions, align_robustly
from colmap_vg.geometry.similarity import Similarity
from colmap_vg.mapping.build import adjust_once_more
from colmap_vg.options import MappingOptions
from colmap_vg.rotations.gravity import MIN_MEASURED, common_direction
from colmap_vg.scene.pose_priors import PosePriors

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_POSITIONS = 3
"""Minimum number of measured positions that determine a similarity."""
MAX_SCALE_UNCERTAINTY = 0.1
"""Standard deviation of the logarithm of the scale above which the positions say nothing about the model: positions
that are as uncertain as the scene is large fit it by a scale of any size."""
MIN_SHARE_RIGHT = 0.5
"""Minimum share of the positions that fit the model."""
MAX_NUM_ROUNDS, SAME_SIGMA = 4, 0.05
"""Maximum number of adjustments, and relative change of the positions' standard deviation at which they end. A bent
model makes positions look worse than they are until it is straight."""
NUM_ROLL_ANGLES, SAME_LEVEL = 3600, 0.05
"""Number of rotations about a line that are compared, and difference of cost below which two ways are as level."""


@dataclass(frozen=True, eq=False)
class Georeference:
    """How a model lies in the frame of measured positions.

    Attributes
    ----------
    frame : str
        ``ENU`` (metres east, north and up of `origin`), or ``cartesian``.
    origin : (float, float, float) or None
        Latitude and longitude in degrees and ellipsoidal height in metres (WGS84).
    sigmas : (float, float, float)
        Standard deviations of the measured positions along the axes, root mean squares over those used.
    outliers : tuple of str
        Names of the images whose measured position is wrong.
    residuals : dict of str to (float, float, float)
        Measured minus model position of each image with a measured position.
    level_is_guessed : bool
        Whether the positions lie on a line, so that the rotation about it was chosen by level photographs.
    """

    frame: str
    origin: tuple[float, float, float] | None
    sigmas: tuple[float, float, float]
    outliers: tuple[str, ...]
    residuals: dict[str, tuple[float, float, float]]
    level_is_guessed: bool


def georeference(
    cache: "pycolmap.DatabaseCache | None",
    model: "pycolmap.Reconstruction",
    priors: PosePriors,
    image_ids: IntArray,
    options: MappingOptions,
    log: StageLog,
) -> Georeference | None:
    """Move a model to the frame of its measured positions, in place, and adjust it to them.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache or None
        None: the model is moved only.
    model : pycolmap.Reconstruction
    priors : PosePriors
    image_ids : (n,) int64 array
        Of the priors.
    options : MappingOptions
    log : StageLog

    Returns
    -------
    Georeference or None
        None where too few positions agree with the model, or they are too uncertain; a warning says so.
    """
    inside = np.isin(image_ids, np.array(sorted(model.reg_image_ids()), dtype=np.int64))
    rows = np.flatnonzero(priors.has_position & inside)
    if len(rows) < MIN_POSITIONS:
        if len(rows):
            log.warn(f"Only {len(rows)} images of a model have a measured position: three or more georeference it.")
        return None
    sigma = np.inf
    for _ in range(MAX_NUM_ROUNDS):
        found = align_robustly(_centers(model, image_ids[rows]), priors.positions[rows], _given(priors, rows), 0)
        problem = why_not(found)
        if problem:
            log.warn(f"The model is not georeferenced: {problem}. It has a scale and a frame of its own.")
            return None
        move_model(model, found.similarity)
        before, sigma = sigma, float(np.sqrt(np.trace(found.covariances[found.right].mean(axis=0)) / 3.0))
        if cache is None or abs(before / sigma - 1.0) <= SAME_SIGMA:
            break
        adjust_once_more(cache, model, options, priors=_pose_priors(found, priors.positions[rows], image_ids[rows]))
    if found.roll_is_free:
        _level(model, priors, image_ids)
    return _told(model, found, priors, image_ids, rows, log)


def _given(priors: PosePriors, rows: IntArray) -> Array | None:
    covariances = priors.covariances[rows]
    return covariances if np.isfinite(covariances).all() else None


def _centers(model: "pycolmap.Reconstruction", image_ids: IntArray) -> Array:
    return np.array([model.image(image_id).projection_center() for image_id in image_ids.tolist()])


def why_not(found: AlignedPositions) -> str:
    """Why an alignment is not to be used; empty if it is."""
    num, right = len(found.right), int(found.right.sum())
    if right < max(MIN_POSITIONS, MIN_SHARE_RIGHT * num):
        return f"only {right} of {num} measured positions agree with it"
    if not found.scale_uncertainty <= MAX_SCALE_UNCERTAINTY:
        return f"its {num} measured positions are too uncertain for its size, and determine its scale to" + (
            f" {found.scale_uncertainty:.0%} only"
        )
    return ""


def move_model(model: "pycolmap.Reconstruction", similarity: Similarity) -> None:
    """Transform a model by a similarity, in place."""
    rotation = pycolmap.Rotation3d(similarity.rotation)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))


def _pose_priors(found: AlignedPositions, positions: Array, image_ids: IntArray) -> list["pycolmap.PosePrior"]:
    """The right positions as COLMAP's priors."""
    priors = []
    for row in np.flatnonzero(found.right).tolist():
        prior = pycolmap.PosePrior(position=positions[row], position_covariance=found.covariances[row])
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1)
        prior.corr_data_id = pycolmap.data_t(sensor, int(image_ids[row]))
        priors.append(prior)
    return priors


def _level(model: "pycolmap.Reconstruction", priors: PosePriors, image_ids: IntArray) -> None:
    """Turn a model about the line of its cameras: gravity down where it was measured, else rows of pixels level."""
    inside = sorted(model.reg_image_ids())
    centers = _centers(model, np.array(inside))
    middle = centers.mean(axis=0)
    axis = np.linalg.svd(centers - middle)[2][0]
    angles = np.linspace(-np.pi, np.pi, NUM_ROLL_ANGLES, endpoint=False)
    # The third row of each rotation about the axis: heights after turning.
    heights = so3.exp(angles[:, None] * axis)[:, 2]
    R = np.array([model.image(i).cam_from_world().rotation.matrix() for i in inside])
    row_of = {int(image_id): row for row, image_id in enumerate(image_ids)}
    gravities = priors.gravities[[row_of[i] for i in inside]]
    measured = np.isfinite(gravities).all(axis=1)
    if measured.any():
        down = np.einsum("kba,kb->ka", R[measured], gravities[measured])
        cost = np.median(heights @ down.T, axis=1)
    else:
        tilted, below, ahead = (heights @ R[:, k].T for k in range(3))
        # Photographs are taken upright or looking down: their lower sides or their views point down.
        ways = np.mean(tilted**2, axis=1) + 0.1 * np.stack([below.mean(axis=1), ahead.mean(axis=1)])
        best = np.argmin(ways, axis=1)
        cost = ways[np.argmin(ways.min(axis=1))]
        if abs(ways[0, best[0]] - ways[1, best[1]]) <= SAME_LEVEL:
            # Rows of pixels along the line are level in both: positions tell a right angle even where they are rough.
            placed = priors.positions[[row_of[i] for i in inside]] - middle
            turns = so3.exp(angles[best][:, None] * axis)
            off = np.linalg.norm(placed - np.einsum("hab,kb->hka", turns, centers - middle), axis=2)
            near = np.minimum(off, 3.0 * np.nanmedian(off))  # wrong positions tell nothing
            cost = ways[np.argmin(np.nanmean(near**2, axis=1))]
    turn = so3.exp(angles[[np.argmin(cost)]][:, None] * axis)[0]
    move_model(model, Similarity(1.0, turn, middle - turn @ middle))


def level_by_gravity(model: "pycolmap.Reconstruction", priors: PosePriors, image_ids: IntArray) -> bool:
    """Turn a model so that measured gravity points down its third axis, in place.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    priors : PosePriors
    image_ids : (n,) int64 array
        Of the priors.

    Returns
    -------
    bool
        False where fewer than three images have a measured gravity, or fewer than half of these agree: the model stays.
    """
    inside = np.isin(image_ids, np.array(sorted(model.reg_image_ids()), dtype=np.int64))
    rows = np.flatnonzero(priors.has_gravity & inside)
    if len(rows) < MIN_MEASURED:
        return False
    R = np.array([model.image(i).cam_from_world().rotation.matrix() for i in image_ids[rows].tolist()])
    down = common_direction(np.einsum("kba,kb->ka", R, priors.gravities[rows]))
    if down is None:
        return False
    # The axis is any horizontal one where the model is upside down.
    axis = np.array([-down[1], down[0], 0.0]) if np.hypot(down[0], down[1]) > 1e-12 else np.array([1.0, 0.0, 0.0])
    angle = np.arctan2(np.hypot(down[0], down[1]), -down[2])
    turn = so3.exp(angle * axis[None] / np.linalg.norm(axis))[0]
    move_model(model, Similarity(1.0, turn, np.zeros(3)))
    return True


def _told(
    model: "pycolmap.Reconstruction",
    found: AlignedPositions,
    priors: PosePriors,
    image_ids: IntArray,
    rows: IntArray,
    log: StageLog,
) -> Georeference:
    """Describe a georeferenced model, with warnings of wrong positions and of a level that is a guess."""
    names = [model.image(image_id).name for image_id in image_ids[rows].tolist()]
    residuals = priors.positions[rows] - _centers(model, image_ids[rows])
    guessed = found.roll_is_free and not priors.has_gravity[rows].any()
    told = described(names, residuals, found, priors.origin, guessed, log)
    if guessed:
        log.warn(
            "The cameras lie nearly on a line, and their measured positions are too uncertain to tell the rotation"
            " about it: it is chosen so that the photographs are level."
        )
    return told


def described(
    names: list[str],
    residuals: Array,
    found: AlignedPositions,
    origin: tuple[float, float, float] | None,
    level_is_guessed: bool,
    log: StageLog,
) -> Georeference:
    """Describe an alignment by the names and residuals (n, 3) of its positions, with a warning of wrong ones."""
    outliers = sorted(name for name, right in zip(names, found.right, strict=True) if not right)
    if outliers:
        log.warn(
            f"{len(outliers)} of {len(names)} measured positions are wrong and not used (first: {outliers[0]}, off by"
            f" {np.linalg.norm(residuals[names.index(outliers[0])]):.3g}); the summary lists all."
        )
    sigmas = np.sqrt(np.diagonal(found.covariances[found.right].mean(axis=0)))
    return Georeference(
        frame="cartesian" if origin is None else "ENU",
        origin=origin,
        sigmas=(float(sigmas[0]), float(sigmas[1]), float(sigmas[2])),
        outliers=tuple(outliers),
        residuals={name: (float(x), float(y), float(z)) for name, (x, y, z) in zip(names, residuals, strict=True)},
        level_is_guessed=level_is_guessed,
    )
