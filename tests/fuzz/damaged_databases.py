"""Random damage to COLMAP databases: a seed gives one to four faults in a copy of a sound database."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pycolmap
from synthetic_databases import MAX_NUM_IMAGES, make_database

Generator = np.random.Generator
Connection = sqlite3.Connection

ODD_NUMBERS = (0, 1, -1, 2, 7, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, -(2**63))
ODD_VALUES = (
    None,
    *ODD_NUMBERS,
    0.5,
    -1e-300,
    1e308,
    float("inf"),
    "",
    "text",
    "7",
    b"",
    b"\x00",
    b"\xff\xfe",
    b"7" * 24,
)
ODD_FLOATS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-310, 1e-30, 1e20, -1e20, 1e38, 1e300, -1.0)
NAMES = (
    b"\xff\xfe.jpg",
    b"",
    b"a\x00b",
    b"../../etc/passwd",
    b"new\nline.jpg",
    b"x" * 5000,
    "ä€😀.jpg".encode(),
    b"/abs.jpg",
)


def sound_databases(folder: Path) -> list[Path]:
    """Databases to be damaged: one camera, one camera each with distortion, stored poses."""
    paths = [folder / name for name in ("one.db", "own.db", "posed.db")]
    radial = ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05))
    make_database(paths[0], num_images=6, num_points=70, noise_px=0.3)
    make_database(
        paths[1], num_images=5, num_points=70, noise_px=0.3, camera=radial, camera_per_image=True,
        has_prior_focal_length=False, seed=2,
    )  # fmt: skip
    make_database(paths[2], num_images=6, num_points=60, noise_px=0.3, stored_poses=True, seed=3)
    return paths


def damaged(sound: list[Path], target: Path, seed: int) -> list[str]:
    """Write a damaged copy; names of the faults."""
    rng = np.random.default_rng(seed)
    shutil.copyfile(sound[int(rng.integers(len(sound)))], target)
    names = [str(name) for name in rng.choice(list(FAULTS), size=int(rng.choice([1, 1, 1, 2, 3, 4])), p=_weights())]
    names.sort(key=lambda name: name in ON_THE_FILE)  # the file's own bytes last: sqlite must still open it
    for name in names:
        if name in ON_THE_FILE:
            ON_THE_FILE[name](target, rng)
            continue
        with closing(sqlite3.connect(target)) as connection:
            connection.execute("PRAGMA foreign_keys = OFF")
            connection.execute("PRAGMA ignore_check_constraints = ON")
            with suppress(sqlite3.Error, OverflowError):  # another fault may have taken the table away
                IN_TABLES[name](connection, rng)
            connection.commit()
    return names


# One row, one value


def _tables(connection: Connection) -> list[str]:
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%' ORDER BY name"
    return [name for (name,) in connection.execute(query)]


def _columns(connection: Connection, table: str) -> list[str]:
    return [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]


def _row(connection: Connection, table: str, rng: Generator) -> int:
    rows = [row for (row,) in connection.execute(f"SELECT rowid FROM {table} ORDER BY rowid")]
    return rows[int(rng.integers(len(rows)))] if rows else -1


def _any_table(connection: Connection, rng: Generator) -> str:
    return str(rng.choice(_tables(connection)))


def _pick(values: tuple[object, ...], rng: Generator) -> object:
    return values[int(rng.integers(len(values)))]


def odd_value(connection: Connection, rng: Generator) -> None:
    table = _any_table(connection, rng)
    column, row = str(rng.choice(_columns(connection, table))), _row(connection, table, rng)
    connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (_pick(ODD_VALUES, rng), row))


def odd_column(connection: Connection, rng: Generator) -> None:
    table = _any_table(connection, rng)
    column = str(rng.choice(_columns(connection, table)))
    connection.execute(f"UPDATE OR IGNORE {table} SET {column} = ?", (_pick(ODD_VALUES, rng),))


BLOBS = [
    ("keypoints", "data", np.float32), ("descriptors", "data", np.uint8), ("matches", "data", np.uint32),
    ("two_view_geometries", "data", np.uint32), ("two_view_geometries", "F", np.float64),
    ("two_view_geometries", "E", np.float64), ("two_view_geometries", "H", np.float64),
    ("two_view_geometries", "qvec", np.float64), ("two_view_geometries", "tvec", np.float64),
    ("cameras", "params", np.float64),
]  # fmt: skip


def _blob(connection: Connection, rng: Generator) -> tuple[str, str, type, int, bytes]:
    table, column, kind = BLOBS[int(rng.integers(len(BLOBS)))]
    row = _row(connection, table, rng)
    found = connection.execute(f"SELECT {column} FROM {table} WHERE rowid = ?", (row,)).fetchone()
    sound = found is not None and isinstance(found[0], bytes) and len(found[0]) % np.dtype(kind).itemsize == 0
    return table, column, kind, row, found[0] if sound else b""


def odd_number_in_a_blob(connection: Connection, rng: Generator) -> None:
    table, column, kind, row, content = _blob(connection, rng)
    values = np.frombuffer(content, dtype=kind).copy()
    if len(values):
        some = rng.integers(len(values), size=int(rng.choice([1, 1, 3, 50])))
        with np.errstate(over="ignore"):
            if np.issubdtype(kind, np.floating):
                values[some] = rng.choice(ODD_FLOATS, size=len(some)).astype(kind)
            else:
                values[some] = rng.choice([0, 1, 69, 70, 1000, np.iinfo(kind).max], size=len(some)) % 2**32
    connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (values.tobytes(), row))


def blob_of_other_length(connection: Connection, rng: Generator) -> None:
    table, column, _, row, content = _blob(connection, rng)
    length = int(rng.choice([0, 1, max(len(content) - 1, 0), len(content) // 2, len(content) + 4, 2 * len(content)]))
    content = (content * 2 + b"\0" * 8)[:length]
    connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (content, row))


def constant_blob(connection: Connection, rng: Generator) -> None:
    table, column, kind, row, content = _blob(connection, rng)
    values = np.frombuffer(content, dtype=kind).copy()
    values[:] = values[0] if len(values) and rng.random() < 0.5 else 0
    where = "" if rng.random() < 0.3 else f"WHERE rowid = {row}"
    connection.execute(f"UPDATE {table} SET {column} = ? {where}", (values.tobytes(),))


# Rows and tables


def row_gone(connection: Connection, rng: Generator) -> None:
    table = _any_table(connection, rng)
    connection.execute(f"DELETE FROM {table} WHERE rowid = ?", (_row(connection, table, rng),))


def rows_gone(connection: Connection, rng: Generator) -> None:
    connection.execute(f"DELETE FROM {_any_table(connection, rng)}")


def table_gone(connection: Connection, rng: Generator) -> None:
    connection.execute(f"DROP TABLE {_any_table(connection, rng)}")


def column_gone(connection: Connection, rng: Generator) -> None:
    table = _any_table(connection, rng)
    connection.execute(f"ALTER TABLE {table} RENAME COLUMN {rng.choice(_columns(connection, table))} TO other")


def row_twice(connection: Connection, rng: Generator) -> None:
    """Without the keys that would forbid it."""
    table = _any_table(connection, rng)
    row = _row(connection, table, rng)
    connection.execute(f"CREATE TABLE copied AS SELECT * FROM {table}")
    connection.execute(f"INSERT INTO copied SELECT * FROM {table} WHERE rowid = ?", (row,))
    connection.execute(f"DROP TABLE {table}")
    connection.execute(f"ALTER TABLE copied RENAME TO {table}")


def other_version(connection: Connection, rng: Generator) -> None:
    connection.execute(f"PRAGMA user_version = {int(rng.choice([0, 1, 3100, 3900, 4000, 99999, -1]))}")


# Images, cameras, pairs


def odd_pair(connection: Connection, rng: Generator) -> None:
    table = str(rng.choice(["matches", "two_view_geometries", "two_view_geometries"]))
    a, b = (int(_pick((0, 1, 2, 3, 4, 5, 6, 77, MAX_NUM_IMAGES - 1), rng)) for _ in range(2))
    new = int(_pick((a * MAX_NUM_IMAGES + b, a, -b, 2**62), rng))
    row = _row(connection, table, rng)
    connection.execute(f"UPDATE {table} SET pair_id = ? WHERE rowid = ?", (new, row))


def match_repeated(connection: Connection, rng: Generator) -> None:
    row = _row(connection, "two_view_geometries", rng)
    found = connection.execute("SELECT data FROM two_view_geometries WHERE rowid = ?", (row,)).fetchone()
    if found is None or not isinstance(found[0], bytes) or len(found[0]) == 0 or len(found[0]) % 8:
        return  # damaged before
    values = np.frombuffer(found[0], dtype=np.uint32).reshape(-1, 2).copy()
    side = int(rng.integers(3))
    values[:, slice(None) if side == 2 else side] = values[0, slice(None) if side == 2 else side]
    connection.execute("UPDATE two_view_geometries SET data = ? WHERE rowid = ?", (values.tobytes(), row))


def matches_shuffled(connection: Connection, rng: Generator) -> None:
    """Some or all pairs match at random."""
    share = rng.random()
    rows = connection.execute("SELECT rowid, data FROM two_view_geometries WHERE rows > 0").fetchall()
    for row, content in rows:
        if rng.random() < share:
            values = np.frombuffer(content, dtype=np.uint32).reshape(-1, 2).copy()
            values[:, 1] = rng.permutation(values[:, 1])
            connection.execute("UPDATE two_view_geometries SET data = ? WHERE rowid = ?", (values.tobytes(), row))


def odd_configuration(connection: Connection, rng: Generator) -> None:
    where = "" if rng.random() < 0.4 else f"WHERE rowid = {_row(connection, 'two_view_geometries', rng)}"
    connection.execute(f"UPDATE two_view_geometries SET config = ? {where}", (int(rng.integers(-2, 12)),))


def odd_camera(connection: Connection, rng: Generator) -> None:
    row, what = _row(connection, "cameras", rng), int(rng.integers(4))
    if what == 0:
        column = str(rng.choice(["width", "height", "model", "prior_focal_length"]))
        connection.execute(f"UPDATE cameras SET {column} = ? WHERE rowid = ?", (_pick(ODD_NUMBERS, rng), row))
    elif what == 1:
        connection.execute("UPDATE cameras SET model = ? WHERE rowid = ?", (int(rng.integers(-1, 25)), row))
    else:
        model = int(rng.integers(0, 17))
        size = len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1000.0, 1024, 768).params)
        params = np.array([1000.0, 1000.0, 512.0, 384.0, *[0.01] * 12])[:size]
        scale = rng.choice([1.0, 1.0, 1e-6, 1e6, -1.0, 0.0], size=size)
        values = (model, (params * scale).tobytes(), row)
        connection.execute("UPDATE cameras SET model = ?, params = ? WHERE rowid = ?", values)


def odd_name(connection: Connection, rng: Generator) -> None:
    name, row = _pick(NAMES, rng), _row(connection, "images", rng)
    connection.execute("UPDATE images SET name = CAST(? AS TEXT) WHERE rowid = ?", (name, row))


def unused_images(connection: Connection, rng: Generator) -> None:
    (camera,) = connection.execute("SELECT min(camera_id) FROM cameras").fetchone()
    for k in range(int(rng.integers(1, 5))):
        image = int(rng.choice([100 + k, 2**31 - 2 - k, 2**31 + k, -5 - k]))
        connection.execute("INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)", (image, f"u{k}", camera))


def other_ids(connection: Connection, rng: Generator) -> None:
    table, column = [("images", "image_id"), ("cameras", "camera_id"), ("frames", "frame_id"), ("rigs", "rig_id")][
        int(rng.integers(4))
    ]
    row = _row(connection, table, rng)
    connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (_pick(ODD_NUMBERS, rng), row))


def odd_frames(connection: Connection, rng: Generator) -> None:
    column = str(rng.choice(["frame_id", "data_id", "sensor_id", "sensor_type"]))
    row = _row(connection, "frame_data", rng)
    connection.execute(f"UPDATE frame_data SET {column} = ? WHERE rowid = ?", (int(rng.integers(-1, 9)), row))


# The file


def cut_off(path: Path, rng: Generator) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(rng.integers(0, len(content)))])


def noise(path: Path, rng: Generator) -> None:
    content = bytearray(path.read_bytes())
    length = int(rng.choice([1, 16, 500]))
    start = int(rng.integers(0, max(len(content) - length, 1)))
    content[start : start + length] = rng.integers(0, 256, length).astype(np.uint8).tobytes()
    path.write_bytes(bytes(content))


Fault = Callable[[Connection, Generator], None]
IN_TABLES: dict[str, Fault] = {
    f.__name__: f
    for f in (
        odd_value, odd_column, odd_number_in_a_blob, blob_of_other_length, constant_blob, row_gone, rows_gone,
        table_gone, column_gone, row_twice, other_version, odd_pair, match_repeated, matches_shuffled,
        odd_configuration, odd_camera, odd_name, unused_images, other_ids, odd_frames,
    )
}  # fmt: skip
ON_THE_FILE: dict[str, Callable[[Path, Generator], None]] = {f.__name__: f for f in (cut_off, noise)}
FAULTS = (*IN_TABLES, *ON_THE_FILE)


def _weights() -> list[float]:
    """Those that most often end in a plain refusal are rarer."""
    weights = [0.3 if name in ("table_gone", "column_gone", "cut_off", "rows_gone") else 1.0 for name in FAULTS]
    return [weight / sum(weights) for weight in weights]
