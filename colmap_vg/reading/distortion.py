"""Radial distortion of lenses whose calibration tells none, found before any pose is trusted.

A known focal length is not a known lens. Two-view geometries that were verified without distortion hold those matches
only that bend little, and every pose found from them bends with the lens. Here the matches as they were before
verification are undistorted by a range of one-parameter lenses; the right one makes most of them agree with fundamental
matrices. The lens is COLMAP's polynomial with the radius over half of the image's diagonal, ``r_d = r_u (1 + kappa
r_u^2)``, which needs no focal length.
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
MAX_PAIRS, PAIRS_PER_IMAGE, MAX_MATCHES, MIN_MATCHES = 16, 3, 200, 30
MAX_ERROR_PX, MAX_NUM_TRIALS = 2.0, 300
MIN_GAIN = 1.03
"""Matches that agree under a lens over those that agree without distortion: 1.06 to 1.22 on wide views with a radial
term of -0.1 or less, and 1.012 at most on photographs whose lenses bend little."""
NUM_NEWTON = 30
FOLD = 0.98
"""Of the largest radius that a lens of negative term reaches: pixels beyond it have no ray."""


def with_found_distortion(tables: DatabaseTables, database_path: str | PathLike[str]) -> tuple[DatabaseTables, Array]:
    """Tables with a radial term for cameras that have no distortion, where the matches tell one.

    Parameters
    ----------
    tables : DatabaseTables
    database_path : path

    Returns
    -------
    tables : DatabaseTables
        Pairs of such cameras have their matches before verification, where the database holds them, and no matrices.
    terms : (c,) array
        COLMAP's radial term of each camera, at the focal length of the database; 0 where none was found.
    """
    terms = np.zeros(len(tables.cameras))
    kinds: dict[object, list[int]] = {}
    for row, camera in enumerate(tables.cameras):
        if has_radial_term(camera) and is_undistorted(camera):
            kinds.setdefault((camera.model_name, camera.width, camera.height), []).append(row)
    caveats = []
    for rows in kinds.values():
        kappa, gain = _found_term(tables, database_path, np.isin(tables.camera_idx, rows))
        if kappa == 0.0:
            continue
        for row in rows:
            lens = tables.cameras[row]
            terms[row] = kappa * (lens.mean_focal_length() / (0.5 * np.hypot(lens.width, lens.height))) ** 2
        others = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        caveats.append(
            f"Camera {tables.cameras[rows[0]].camera_id}{others}: the database tells no distortion, and"
            f" {gain - 1.0:.0%} more of the matches agree under a radial term of {terms[rows[0]]:.3f}. It is used from"
            " the start, and pairs are verified anew."
        )
    if not caveats:
        return tables, terms
    cameras = tuple(with_radial_term(c, t) if t else c for c, t in zip(tables.cameras, terms.tolist(), strict=True))
    bent = replace(tables, cameras=cameras, caveats=(*tables.caveats, *caveats))
    of_bent = np.asarray((terms != 0.0)[tables.camera_idx[tables.pairs]].any(axis=1))
    return with_raw_matches(bent, database_path, of_bent), terms


def _found_term(tables: DatabaseTables, database_path: str | PathLike[str], images: BoolArray) -> tuple[float, float]:
    """The term under which most matches between marked images agree, and the gain over none; 0 where that is small."""
    pairs, matches = _matches_to_ask(tables, database_path, images)
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


def _matches_to_ask(
    tables: DatabaseTables, database_path: str | PathLike[str], images: BoolArray
) -> tuple[list[tuple[int, int]], list[IntArray]]:
    """Pairs of marked images with most matches, a few of each image, and their matches before verification."""
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
    """Keypoints (k, 2) about the principal point over half of the image's diagonal, and that half, pixels."""
    camera = tables.cameras[tables.camera_idx[image]]
    half = 0.5 * float(np.hypot(camera.width, camera.height))
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    return (tables.keypoints[image][rows].astype(np.float64) - middle) / half, half


def _num_agreeing(points: list[list[tuple[Array, float]]], kappa: float) -> int:
    """Matches of all pairs that agree with their pair's fundamental matrix once they are undistorted."""
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
        About the principal point.
    kappa : float

    Returns
    -------
    (k, 2) array
        NaN beyond `FOLD` of the largest radius that such a lens reaches.
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
