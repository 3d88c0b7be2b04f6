"""Matches of pairs for the report."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import changed_copy, make_database, sha256

from colmap_vg.errors import DatabaseError
from colmap_vg.report.matches import MAX_MATCHES, pair_matches


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("matches") / "database.db"
    make_database(path, num_images=4, num_points=60)
    return path


def names(path: Path) -> list[str]:
    with closing(sqlite3.connect(path)) as connection:
        return [name for (name,) in connection.execute("SELECT name FROM images ORDER BY image_id")]


def test_they_are_those_that_pycolmap_reads(database_path: Path, tmp_path: Path) -> None:
    first, second = names(database_path)[:2]
    before = sha256(database_path)
    forth, back, unknown = pair_matches(database_path, [(first, second), (second, first), (first, "nobody")])
    assert sha256(database_path) == before
    with pycolmap.Database.open(changed_copy(database_path, tmp_path / "copy.db")) as database:
        images = [database.read_image_with_name(name) for name in (first, second)]
        camera = database.read_camera(images[0].camera_id)
        rows = database.read_two_view_geometry(images[0].image_id, images[1].image_id).inlier_matches
        keypoints = [database.read_keypoints(image.image_id)[:, :2] for image in images]
    expected = np.hstack([own[row] / [camera.width, camera.height] for own, row in zip(keypoints, rows.T, strict=True)])
    assert len(rows) <= MAX_MATCHES
    np.testing.assert_allclose(forth, expected)
    np.testing.assert_array_equal(back, forth[:, [2, 3, 0, 1]])
    assert unknown is None


def test_damaged_rows_have_none(database_path: Path, tmp_path: Path) -> None:
    first, second, third = names(database_path)[:3]
    damaged = changed_copy(
        database_path,
        tmp_path / "damaged.db",
        "UPDATE keypoints SET rows = 3, data = zeroblob(cols * 12) WHERE image_id = 1",
        "UPDATE two_view_geometries SET rows = rows + 1",
    )
    assert pair_matches(damaged, [(first, second), (second, third)]) == [None, None]


def test_a_missing_database_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError):
        pair_matches(tmp_path / "none.db", [])
