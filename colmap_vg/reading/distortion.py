"""Estimate a radial distortion term for cameras without distortion, before any relative pose is estimated.

Where distortion is not modelled, two-view verification keeps only the matches that it hardly affects, and all poses
estimated from them are biased. Here the matches as they were before verification are undistorted with a range of
one-parameter models; the correct one maximises the number of matches that agree with fundamental matrices. The model is
COLMAP's polynomial with the radius in units of half the image diagonal, ``r_d = r_u (1 + kappa r_u^2)``, which needs no
focal length.
"""

from dataclasses import replace
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import has_radial_term, is_undistorted, with_radial_term
from colmap_vg.colmap_io.database import reading
from colmap_vg.colmap_io.raw_matches import raw_matches, with_raw_matches
from colmap_vg.colmap_io.tables import MAX_NUM_IMAGES, DatabaseTables

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

COARSE, FINE = np.array([-0.3, -0.2, -0.1, 0.0, 0.12]), np.linspace(-0.06, 0.06, 7)
"""Values of kappa that are tried, dimensionless; then offsets from the best of them."""
MAX_PAIRS, PAIRS_PER_IMAGE, MAX_MATCHES, MIN_MATCHES = 16, 3, 200, 30
"""Maximum number of pairs, of pairs per image, and of matches per pair; minimum number of matches per pair."""
MAX_ERROR_PX, MAX_NUM_TRIALS = 2.0, 300
"""Maximum Sampson error of RANSAC, pixels, and its maximum number of trials."""
MIN_GAIN = 1.03
"""Minimum ratio of the number of agreeing matches with distortion to that without: measured 1.06 to 1.22 on wide views
with a radial term of -0.1 or less, and 1.012 at most on photographs with little distortion."""
NUM_NEWTON = 30
"""Newton iterations that invert the polynomial."""
FOLD = 0.98
"""Share of the largest distorted radius for a negative kappa, beyond which pixels cannot be undistorted."""


def with_found_distortion(
    tables: DatabaseTables, database_path: str | PathLike[str], calibrated: BoolArray | None = None
) -> tuple[DatabaseTables, Array]:
    """Add a radial term to cameras without distortion, where the matches support one.

    Parameters
    ----------
    tables : DatabaseTables
    database_path : path
    calibrated : (c,) bool array, optional
        Cameras whose lens is known to have no more distortion than stated.

    Returns
    -------
    tables : DatabaseTables
        Pairs of such cameras have no matrices, and their matches before verification if the database holds them.
    terms : (c,) array
        COLMAP's radial term of each camera, dimensionless, at the focal length of the database; 0 where none was found.
    """
    terms = np.zeros(len(tables.cameras))
    kinds: dict[object, list[int]] = {}
    for row, camera in enumerate(tables.cameras):
        if has_radial_term(camera) and is_undistorted(camera) and (calibrated is None or not calibrated[row]):
            kinds.setdefault((camera.model_name, camera.width, camera.height), []).append(row)
    caveats = []
    for rows in kinds.values():
        kappa, gain = _estimated_term(tables, database_path, np.isin(tables.camera_idx, rows))
        if kappa == 0.0:
            continue
        for row in rows:
            lens = tables.cameras[row]
            terms[row] = kappa * (lens.mean_focal_length() / (0.5 * np.hypot(lens.width, lens.height))) ** 2
        others = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        caveats.append(
            f"Camera {tables.cameras[rows[0]].camera_id}{others}: the database has no distortion, but"
            f" {gain - 1.0:.0%} more matches agree with a radial term of {terms[rows[0]]:.3f}. This is the initial"
            " distortion, and the pairs are verified again with it."
        )
    if not caveats:
        return tables, terms
    cameras = tuple(with_radial_term(c, t) if t else c for c, t in zip(tables.cameras, terms.tolist(), strict=True))
    distorted = replace(tables, cameras=cameras, caveats=(*tables.caveats, *caveats))
    of_distorted = np.asarray((terms != 0.0)[tables.camera_idx[tables.pairs]].any(axis=1))
    return with_raw_matches(distorted, database_path, of_distorted), terms


def _estimated_term(
    tables: DatabaseTables, database_path: str | PathLike[str], images: BoolArray
) -> tuple[float, float]:
    """Kappa that maximises the agreeing matches between marked images, and its gain; 0 where the gain is too small."""
    pairs, matches = _sampled_matches(tables, database_path, images)
    if not pairs:
        return 0.0, 1.0
    points = [
        [_centered(tables, image, rows[:, side]) for side, image in enumerate(pair)]
        for pair, rows in zip(pairs, matches, strict=True)
    ]
    counts = [_num_agreeing(points, kappa) for kappa in COARSE]
    best, without = float(COARSE[int(np.argmax(counts))]), max(counts[int(np.flatnonzero(COARSE == 0.0)[0])], 1)
    if best == 0.0:
        return 0.0, 1.0
    fine = best + FINE
    counts = [_num_agreeing(points, kappa) for kappa in fine]
    gain = max(counts) / without
    return (float(fine[int(np.argmax(counts))]), gain) if gain >= MIN_GAIN else (0.0, 1.0)


def _sampled_matches(
    tables: DatabaseTables, database_path: str | PathLike[str], images: BoolArray
) -> tuple[list[tuple[int, int]], list[IntArray]]:
    """Sample pairs of marked images with many matches, a few per image, and their matches before verification."""
    row_of = {int(image_id): row for row, image_id in enumerate(tables.image_ids)}
    count = np.zeros(len(tables.image_ids), dtype=int)
    pairs, found = [], []
    with reading(database_path) as connection:
        listed = connection.execute(
            "SELECT pair_id FROM matches WHERE rows >= ? AND typeof(data) = 'blob' ORDER BY rows DESC, pair_id",
            (MIN_MATCHES,),
        ).fetchall()
        for (pair_id,) in listed:
            pair = row_of.get(pair_id // MAX_NUM_IMAGES, -1), row_of.get(pair_id % MAX_NUM_IMAGES, -1)
            if min(pair) < 0 or not images[list(pair)].all() or count[list(pair)].max() >= PAIRS_PER_IMAGE:
                continue
            matches = raw_matches(connection, tables, pair)
            if matches is None:
                continue
            count[list(pair)] += 1
            pairs.append(pair)
            found.append(matches[np.unique(np.linspace(0, len(matches) - 1, MAX_MATCHES).astype(int))])
            if len(pairs) == MAX_PAIRS:
                break
    return pairs, found


def _centered(tables: DatabaseTables, image: int, rows: IntArray) -> tuple[Array, float]:
    """Keypoints (k, 2) relative to the principal point, in units of half the image diagonal, and that half, pixels."""
    camera = tables.cameras[tables.camera_idx[image]]
    half = 0.5 * float(np.hypot(camera.width, camera.height))
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    return (tables.keypoints[image][rows].astype(np.float64) - middle) / half, half


def _num_agreeing(points: list[list[tuple[Array, float]]], kappa: float) -> int:
    """Number of matches that agree with their pair's fundamental matrix after undistortion, over all pairs."""
    options = pycolmap.RANSACOptions(
        max_error=MAX_ERROR_PX, min_num_trials=30, max_num_trials=MAX_NUM_TRIALS, random_seed=0
    )
    total = 0
    for (x1, half1), (x2, half2) in points:
        u1, u2 = half1 * undistorted(x1, kappa), half2 * undistorted(x2, kappa)
        seen = np.isfinite(u1).all(axis=1) & np.isfinite(u2).all(axis=1)
        if seen.sum() >= MIN_MATCHES // 2:
            found = pycolmap.estimate_fundamental_matrix(u1[seen], u2[seen], options)
            total += 0 if found is None else int(found["num_inliers"])
    return total


def undistorted(points: Array, kappa: float) -> Array:
    """Undistort points by ``r_d = r_u (1 + kappa r_u^2)``.

    Parameters
    ----------
    points : (k, 2) array
        Relative to the principal point, in units of half the image diagonal.
    kappa : float
        Dimensionless.

    Returns
    -------
    (k, 2) array
        NaN beyond `FOLD` of the largest distorted radius.
    """
    r = np.linalg.norm(points, axis=1)
    largest = np.sqrt(-1.0 / (3.0 * kappa)) if kappa < 0 else np.inf
    u = np.minimum(r, largest)
    for _ in range(NUM_NEWTON):
        slope = np.maximum(1.0 + 3.0 * kappa * u * u, 1e-6)
        u = np.clip(u - (u * (1.0 + kappa * u * u) - r) / slope, 0.0, np.minimum(largest, 1e3))
    if kappa < 0:
        u[r > FOLD * largest * (1.0 + kappa * largest**2)] = np.nan
    return np.asarray(points * (u / np.maximum(r, 1e-12))[:, None])
