"""COLMAP databases as files: checked without touching them, copied before anything is opened for writing.

pycolmap's ``Database.open`` changes a few bytes of any database, migrates old ones and creates missing ones, so the
user's file is only ever read by sqlite, and pycolmap gets a copy.
"""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from colmap_vg.errors import DatabaseError

REQUIRED_TABLES = ("cameras", "images", "keypoints", "two_view_geometries")
_SQLITE_MAGIC = b"SQLite format 3\x00"


@contextmanager
def reading(database_path: str | PathLike[str]) -> Iterator[sqlite3.Connection]:
    """A connection that reads a database without changing it or leaving files beside it.

    Raises
    ------
    DatabaseError
        The file is missing, empty, no database, damaged, or lacks COLMAP's tables.
    """
    path = Path(database_path)
    _check_file(path)
    with TemporaryDirectory() as folder:
        # What another process has written but not merged yet stands in the -wal file; only a copy of both shows it.
        if _has_log(path):
            path = _copied(path, Path(folder) / "database.db")
            uri = f"file:{quote(str(path))}?mode=rw"
        else:
            uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        try:
            with closing(sqlite3.connect(uri, uri=True)) as connection:
                connection.text_factory = lambda raw: raw.decode("utf-8", errors="replace")
                _check_tables(connection, Path(database_path))
                yield connection
        except sqlite3.Error as error:
            raise DatabaseError(f"{database_path}: the database cannot be read ({error}); make it again") from error


def check_database(database_path: str | PathLike[str]) -> None:
    """Refuse what cannot be mapped before any work is done, without changing the file.

    Raises
    ------
    DatabaseError
        As for :func:`reading`; also when there are no images, no verified pairs, or a rig of several cameras.
    """
    with reading(database_path) as connection:
        (num_images,) = connection.execute("SELECT COUNT(*) FROM images").fetchone()
        if num_images == 0:
            raise DatabaseError(f"{database_path}: holds no images; extract features first")
        (num_pairs,) = connection.execute("SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0").fetchone()
        if num_pairs == 0:
            raise DatabaseError(
                f"{database_path}: holds {num_images} images but no verified pairs; match them first"
                " (colmap exhaustive_matcher), or verify the matches (colmap geometric_verifier)"
            )
        _refuse_rigs(connection, Path(database_path))


def working_copy(database_path: str | PathLike[str], folder: Path) -> Path:
    """Copy of a checked database in a folder, for pycolmap to open.

    Raises
    ------
    DatabaseError
        The copy cannot be made.
    """
    return _copied(Path(database_path), folder / "working_copy.db")


def _has_log(path: Path) -> bool:
    log = path.with_name(path.name + "-wal")
    return log.exists() and log.stat().st_size > 0


def _copied(path: Path, target: Path) -> Path:
    try:
        shutil.copyfile(path, target)
        if _has_log(path):
            shutil.copyfile(path.with_name(path.name + "-wal"), target.with_name(target.name + "-wal"))
    except OSError as error:
        raise DatabaseError(f"{path}: cannot be copied to {target} ({error.strerror})") from error
    return target


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise DatabaseError(f"{path}: is a folder, expected a COLMAP database file")
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE_MAGIC))
    except OSError as error:
        raise DatabaseError(f"{path}: cannot be read ({error.strerror}); give the path of a COLMAP database") from error
    if not head:
        raise DatabaseError(f"{path}: is empty; extract and match features first")
    if head != _SQLITE_MAGIC:
        raise DatabaseError(f"{path}: is no SQLite file; give the path of a COLMAP database")


def _check_tables(connection: sqlite3.Connection, path: Path) -> None:
    found = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    missing = [name for name in REQUIRED_TABLES if name not in found]
    if missing:
        raise DatabaseError(f"{path}: is no COLMAP database, it has no table {', '.join(missing)}")


def _refuse_rigs(connection: sqlite3.Connection, path: Path) -> None:
    """Setting the pose of one image of a rig moves the others: until rigs are solved as such, none is better."""
    tables = connection.execute("SELECT COUNT(*) FROM sqlite_master WHERE name = 'rig_sensors'").fetchone()
    if tables[0] == 0:  # an older schema
        return
    rig = connection.execute("SELECT rig_id, COUNT(*) + 1 FROM rig_sensors GROUP BY rig_id ORDER BY rig_id").fetchone()
    if rig is not None:
        raise DatabaseError(
            f"{path}: rig {rig[0]} has {rig[1]} sensors; rigs are not supported yet: map the images with"
            " pycolmap.global_mapping, or make the database without a rig"
        )
