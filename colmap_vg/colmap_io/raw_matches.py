"""Read a database's matches before verification, and the pairs of images that were compared."""

import sqlite3
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import reading
from colmap_vg.colmap_io.tables import MAX_NUM_IMAGES, UNDEFINED, DatabaseTables

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MATRICES = ("E", "F", "H", "rotations", "translations")


def raw_matches(connection: sqlite3.Connection, tables: DatabaseTables, pair: tuple[int, int]) -> IntArray | None:
    """Matches (k, 2) of a pair, given as rows of images, before verification; None if they are missing or damaged."""
    image_id1, image_id2 = (int(tables.image_ids[image]) for image in pair)
    found = connection.execute(
        "SELECT rows, cols, data FROM matches WHERE pair_id = ? AND typeof(data) = 'blob'",
        (image_id1 * MAX_NUM_IMAGES + image_id2,),
    ).fetchone()
    if found is None or found[1] != 2 or found[0] * 8 != len(found[2]):
        return None
    matches = np.frombuffer(found[2], dtype=np.uint32).reshape(-1, 2).astype(np.int64)
    size = [len(tables.keypoints[image]) for image in pair]
    return matches if len(matches) and (matches < size).all() else None


def with_raw_matches(tables: DatabaseTables, database_path: str | PathLike[str], marked: BoolArray) -> DatabaseTables:
    """Replace the matches of marked pairs (m,) by those before verification, and their matrices by NaN."""
    kept = [tables.matches[a:b] for a, b in zip(tables.offsets[:-1], tables.offsets[1:], strict=True)]
    with reading(database_path) as connection:
        for row in np.flatnonzero(marked).tolist():
            i, j = tables.pairs[row].tolist()
            raw = raw_matches(connection, tables, (i, j))
            kept[row] = kept[row] if raw is None else raw
    offsets = np.concatenate([[0], np.cumsum([len(m) for m in kept])]).astype(np.int64)
    return without_matrices(replace(tables, matches=np.concatenate(kept), offsets=offsets), marked)


def without_matrices(tables: DatabaseTables, marked: BoolArray) -> DatabaseTables:
    """Replace the matrices and poses of marked pairs (m,) by NaN."""
    matrices = {name: getattr(tables, name).copy() for name in _MATRICES}
    for matrix in matrices.values():
        matrix[marked] = np.nan
    return replace(tables, **matrices)


def with_unverified_pairs(
    tables: DatabaseTables, database_path: str | PathLike[str], images: BoolArray, min_num_matches: int
) -> DatabaseTables:
    """Add the pairs of marked images (n,) for which COLMAP found no geometry, with their matches before verification.

    Their configuration is `UNDEFINED`, their matrices are NaN. Pairs that were never verified are not added.
    """
    row_of = {int(image_id): row for row, image_id in enumerate(tables.image_ids)}
    pairs, matches = [], []
    with reading(database_path) as connection:
        without = connection.execute("SELECT pair_id FROM two_view_geometries WHERE rows = 0 ORDER BY pair_id")
        for (pair_id,) in without.fetchall():
            pair = row_of.get(pair_id // MAX_NUM_IMAGES, -1), row_of.get(pair_id % MAX_NUM_IMAGES, -1)
            if min(pair) < 0 or not images[list(pair)].all():
                continue
            raw = raw_matches(connection, tables, pair)
            if raw is not None and len(raw) >= min_num_matches:
                pairs.append(pair)
                matches.append(raw)
    if not pairs:
        return tables
    every = [tables.matches[a:b] for a, b in zip(tables.offsets[:-1], tables.offsets[1:], strict=True)] + matches
    joined = np.concatenate([tables.pairs, np.array(pairs, dtype=np.int64)])
    order = np.lexsort((joined[:, 1], joined[:, 0]))
    matrices: dict[str, Any] = {
        name: np.concatenate([(old := getattr(tables, name)), np.full((len(pairs), *old.shape[1:]), np.nan)])[order]
        for name in _MATRICES
    }
    return replace(
        tables,
        pairs=joined[order],
        configs=np.concatenate([tables.configs, np.full(len(pairs), UNDEFINED)])[order],
        matches=np.concatenate([every[row] for row in order]),
        offsets=np.concatenate([[0], np.cumsum([len(every[row]) for row in order])]).astype(np.int64),
        **matrices,
    )


def compared_pairs(database_path: str | PathLike[str]) -> IntArray:
    """Image ids (k, 2) of the pairs that were compared, matched or not: COLMAP stores pairs without matches, too."""
    with reading(database_path) as connection:
        tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        queries = [f"SELECT pair_id FROM {name}" for name in ("matches", "two_view_geometries") if name in tables]
        found = connection.execute(" UNION ".join(queries)).fetchall()
    pair_ids = np.array(found, dtype=np.int64).reshape(-1)
    return np.stack([pair_ids // MAX_NUM_IMAGES, pair_ids % MAX_NUM_IMAGES], axis=1)
