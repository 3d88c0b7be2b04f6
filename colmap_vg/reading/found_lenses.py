"""Lenses that a first solution found, with which a viewing graph is read again.

Relative poses of distorted views, or of a wrong focal length, are wrong by as much as tens of degrees, though the
adjustment of all cameras to their matches finds the lens. With it they are estimated anew from the verified matches, or
verified anew where the first reading did that, too.
"""

from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import focal_length, has_radial_term, with_focal_scale, with_radial_term
from colmap_vg.colmap_io.raw_matches import with_raw_matches, without_matrices
from colmap_vg.colmap_io.tables import DatabaseTables

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MIN_CHANGE = 1e-6
"""Least change of a focal length, relative, and of a radial term for a lens to be another one than the database's."""


@dataclass(frozen=True, eq=False)
class FoundLenses:
    """Calibrations of all cameras of a database, in its order.

    Attributes
    ----------
    focal_lengths : (c,) array
        Pixels.
    radial_terms : (c,) array
        At these focal lengths, dimensionless.
    terms_on_reading : (c,) array
        Radial terms that reading had found before, at the database's focal lengths: both are added to its distortion.
    verified_anew : (c,) bool array
        Cameras most of whose pairs were verified anew on reading.
    """

    focal_lengths: Array
    radial_terms: Array
    terms_on_reading: Array
    verified_anew: BoolArray


def with_found_lenses(
    tables: DatabaseTables, database_path: str | PathLike[str], lenses: FoundLenses
) -> tuple[DatabaseTables, Array, BoolArray]:
    """Give cameras the calibrations that were found.

    Parameters
    ----------
    tables : DatabaseTables
    database_path : path
    lenses : FoundLenses

    Returns
    -------
    tables : DatabaseTables
        Pairs of changed cameras have no matrices. Their matches stay, or are those before verification if the pairs of
        a camera were verified anew.
    terms : (c,) array
        The radial terms at the database's focal lengths.
    changed : (c,) bool array
        Cameras with another calibration than the database's.
    """
    count = len(tables.cameras)
    cameras, terms, changed = list(tables.cameras), np.zeros(count), np.zeros(count, dtype=bool)
    for row, camera in enumerate(tables.cameras):
        if camera.is_spherical():
            continue
        scale, term = float(lenses.focal_lengths[row]) / focal_length(camera), 0.0
        if has_radial_term(camera):
            term = float(lenses.terms_on_reading[row] + lenses.radial_terms[row] / scale**2)
        if max(abs(scale - 1.0), abs(term)) > MIN_CHANGE:
            cameras[row] = with_focal_scale(with_radial_term(camera, term) if term else camera, scale)
            terms[row], changed[row] = term, True
    found = replace(tables, cameras=tuple(cameras))
    raw = np.asarray((changed & lenses.verified_anew)[tables.camera_idx[tables.pairs]].any(axis=1))
    of_changed = np.asarray(changed[tables.camera_idx[tables.pairs]].any(axis=1))
    return with_raw_matches(without_matrices(found, of_changed), database_path, raw), terms, changed
