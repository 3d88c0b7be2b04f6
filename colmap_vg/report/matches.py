"""Inlier matches of a few pairs from a database, in shares of the images' sides."""

import sqlite3
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import reading
from colmap_vg.colmap_io.tables import MAX_NUM_IMAGES

Array = NDArray[np.float64]

MAX_MATCHES = 80
"""Maximum number of matches shown of a pair."""


def pair_matches(database_path: str | PathLike[str], pairs: Sequence[tuple[str, str]]) -> list[Array | None]:
    """Read inlier matches of pairs, evenly subsampled; the database is not changed.

    Parameters
    ----------
    database_path : path
    pairs : sequence of (str, str)
        Names of the images.

    Returns
    -------
    list of (k, 4) array or None
        Position in the first and in the second image, each as a share of its width and height; None where the database
        lacks the pair, or its rows are damaged.

    Raises
    ------
    DatabaseError
        The database is missing or damaged.
    """
    with reading(database_path) as connection:
        return [_matches(connection, *pair) for pair in pairs]


def _matches(connection: sqlite3.Connection, name1: str, name2: str) -> Array | None:
    id1, id2 = _image_id(connection, name1), _image_id(connection, name2)
    if id1 is None or id2 is None:
        return None
    keypoints1, keypoints2 = _keypoints(connection, id1), _keypoints(connection, id2)
    found = connection.execute(
        "SELECT rows, data FROM two_view_geometries WHERE pair_id = ? AND cols = 2 AND typeof(data) = 'blob'",
        (min(id1, id2) * MAX_NUM_IMAGES + max(id1, id2),),
    ).fetchone()
    if keypoints1 is None or keypoints2 is None or found is None or found[0] * 8 != len(found[1]):
        return None
    matches = np.frombuffer(found[1], dtype=np.uint32).reshape(-1, 2).astype(np.int64)
    matches = matches[np.linspace(0, len(matches) - 1, min(len(matches), MAX_MATCHES)).astype(np.int64)]
    rows1, rows2 = matches.T if id1 < id2 else matches.T[::-1]
    if (rows1 >= len(keypoints1)).any() or (rows2 >= len(keypoints2)).any():
        return None
    return np.concatenate([keypoints1[rows1], keypoints2[rows2]], axis=1)


def _image_id(connection: sqlite3.Connection, name: str) -> int | None:
    found = connection.execute("SELECT image_id FROM images WHERE name = ?", (name,)).fetchone()
    return None if found is None else int(found[0])


def _keypoints(connection: sqlite3.Connection, image_id: int) -> Array | None:
    """Keypoints (k, 2) of an image, in shares of its width and height."""
    found = connection.execute(
        "SELECT k.rows, k.cols, k.data, c.width, c.height FROM keypoints k JOIN images i USING (image_id)"
        " JOIN cameras c USING (camera_id) WHERE image_id = ? AND typeof(k.data) = 'blob'",
        (image_id,),
    ).fetchone()
    if found is None or found[1] < 2 or found[0] * found[1] * 4 != len(found[2]) or min(found[3:]) <= 0:
        return None
    xy = np.frombuffer(found[2], dtype=np.float32).reshape(found[0], found[1])[:, :2]
    return np.asarray(xy / np.array(found[3:], dtype=np.float64))
