"""Open COLMAP databases without modifying them, check them, and copy them for pycolmap.

pycolmap's ``Database.open`` changes a few bytes of any database, migrates old ones and creates missing ones, so the
user's file is only read through sqlite, and pycolmap opens a copy.
"""

import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from colmap_vg.colmap_io.cameras import FISHEYES
from colmap_vg.errors import DatabaseError

REQUIRED_TABLES = ("cameras", "images", "keypoints", "two_view_geometries")
CAMERA_SENSOR = 0
"""COLMAP's type of sensors that are cameras, as stored in frames, rigs and pose priors."""
PATIENCE = 5.0
"""Seconds to wait for another process that is writing to a database."""
_SQLITE_MAGIC = b"SQLite format 3\x00"


@contextmanager
def reading(database_path: str | PathLike[str]) -> Iterator[sqlite3.Connection]:
    """Open a read-only connection to a database, without changing it or leaving files beside it.

    Raises
    ------
    DatabaseError
        The file is missing, empty, no database, damaged, lacks COLMAP's tables, or another process is writing it.
    """
    path = Path(database_path)
    in_wal_mode = _check_file(path)
    with ExitStack() as stack:
        before = _state(path)
        if before.sides:
            # Changes that a writer has not merged yet, or may roll back, are in a file beside the database: only a
            # copy of both shows the last committed transaction.
            folder = stack.enter_context(_temporary_folder(path))
            uri = f"file:{quote(str(_copied(path, folder / 'database.db')))}?mode=rw"
        else:
            # In WAL mode every reader leaves files beside the database unless it is opened as immutable; without a
            # -wal file no process has it open. In other modes readers leave no files and respect the writers' locks.
            uri = f"file:{quote(str(path.resolve()))}?mode=ro{'&immutable=1' if in_wal_mode else ''}"
        try:
            connection = stack.enter_context(closing(sqlite3.connect(uri, timeout=PATIENCE, uri=True)))
            connection.text_factory = lambda raw: raw.decode("utf-8", errors="replace")
            _check_tables(connection, path)
            yield connection
        except sqlite3.Error as error:
            if "locked" in str(error):
                raise _written_by_another(path) from error
            raise DatabaseError(f"{database_path}: the database cannot be read ({error}); create it again") from error
        except (OverflowError, UnicodeDecodeError) as error:  # sqlite's message may quote damaged bytes, too
            raise DatabaseError(f"{database_path}: the database is damaged ({error}); create it again") from error
        if not before.sides and _state(path) != before:
            raise _written_by_another(path)


def check_database(database_path: str | PathLike[str]) -> None:
    """Raise an error for a database that cannot be mapped; the file is not changed.

    Raises
    ------
    DatabaseError
        As for :func:`reading`; also when there are no images or no verified pairs.
    """
    with reading(database_path) as connection:
        (num_images,) = connection.execute("SELECT COUNT(*) FROM images").fetchone()
        if num_images == 0:
            raise DatabaseError(f"{database_path}: contains no images; extract features first")
        (num_pairs,) = connection.execute("SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0").fetchone()
        if num_pairs == 0 and not _has_unverified_fisheyes(connection):
            raise DatabaseError(
                f"{database_path}: contains {num_images} images but no verified pairs; match them first"
                " (colmap exhaustive_matcher), or verify the matches (colmap geometric_verifier)"
            )


def _has_unverified_fisheyes(connection: sqlite3.Connection) -> bool:
    """Whether there are matches of fisheyes without a focal length, of which COLMAP verifies no pair."""
    cameras = connection.execute("SELECT model FROM cameras WHERE prior_focal_length = 0").fetchall()
    if not any(model in FISHEYES.values() for (model,) in cameras):
        return False
    (num_pairs,) = connection.execute("SELECT COUNT(*) FROM matches WHERE rows > 0").fetchone()
    return bool(num_pairs > 0)


def working_copy(database_path: str | PathLike[str], folder: Path) -> Path:
    """Copy a checked database to a folder, for pycolmap to open.

    Raises
    ------
    DatabaseError
        The copy cannot be made.
    """
    return _copied(Path(database_path), folder / "working_copy.db")


@dataclass(frozen=True)
class _State:
    """State of a database file (inode, size, time), and the names of sqlite's files with changes beside it."""

    file: tuple[int, int, int]
    sides: tuple[str, ...]


def _state(path: Path) -> _State:
    try:
        status = path.stat()
        beside = [path.with_name(path.name + ending) for ending in ("-wal", "-journal")]
        sides = tuple(side.name for side in beside if side.exists() and side.stat().st_size > 0)
    except OSError as error:
        raise DatabaseError(f"{path}: cannot be read ({error.strerror})") from error
    return _State((status.st_ino, status.st_size, status.st_mtime_ns), sides)


@contextmanager
def _temporary_folder(path: Path) -> Iterator[Path]:
    try:
        folder = TemporaryDirectory()
    except OSError as error:
        raise DatabaseError(
            f"{path}: cannot be copied to the folder for temporary files ({error.strerror}); set TMPDIR to another one"
        ) from error
    with folder as name:
        yield Path(name)


def _copied(path: Path, target: Path) -> Path:
    """Copy a database, again if a writer changed it meanwhile."""
    deadline = time.monotonic() + PATIENCE
    while True:
        before = _state(path)
        try:
            # sqlite would read files that a killed job left as changes of the new copy.
            for leftover in target.parent.glob(target.name + "*"):
                leftover.unlink()
            shutil.copyfile(path, target)
            for side in before.sides:
                shutil.copyfile(path.with_name(side), target.with_name(target.name + side.removeprefix(path.name)))
        except FileNotFoundError:
            if time.monotonic() > deadline or not path.exists():
                raise _written_by_another(path) from None
            continue
        except OSError as error:
            raise DatabaseError(f"{path}: cannot be copied to {target} ({error.strerror})") from error
        if _state(path) == before:
            return target
        if time.monotonic() > deadline:
            raise _written_by_another(path)
        time.sleep(0.05)


def _written_by_another(path: Path) -> DatabaseError:
    return DatabaseError(f"{path}: another process is writing to the database; wait until it has finished")


def _check_file(path: Path) -> bool:
    """Check that the file is an SQLite database, and return whether it is in WAL mode."""
    if path.is_dir():
        raise DatabaseError(f"{path}: is a folder, expected a COLMAP database file")
    try:
        with path.open("rb") as file:
            head = file.read(20)
    except OSError as error:
        raise DatabaseError(f"{path}: cannot be read ({error.strerror}); give the path of a COLMAP database") from error
    if not head:
        raise DatabaseError(f"{path}: is empty; extract and match features first")
    if not head.startswith(_SQLITE_MAGIC):
        raise DatabaseError(f"{path}: is not an SQLite file; give the path of a COLMAP database")
    return head[18:20] != b"\x01\x01"  # the file format's read and write versions: 1 legacy, 2 WAL


def _check_tables(connection: sqlite3.Connection, path: Path) -> None:
    found = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    missing = [name for name in REQUIRED_TABLES if name not in found]
    if missing:
        raise DatabaseError(f"{path}: is not a COLMAP database, it has no table {', '.join(missing)}")
