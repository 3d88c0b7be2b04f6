"""Each damaged row of a database is named, with what is wrong; the file is read only."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import DAMAGES, changed_copy, make_database, sha256

from colmap_vg.colmap_io.database import check_database, reading, working_copy
from colmap_vg.errors import DatabaseError
from colmap_vg.jobs.mapper import view_graph_mapping
from colmap_vg.options import MappingOptions
from colmap_vg.reading.read import read_view_graph
from colmap_vg.scene.solution import SolutionStatus
from colmap_vg.solver.solve import solve_view_graph


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "database.db"
    make_database(path, num_images=4, num_points=60)
    return path


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_row_is_named(sound: Path, tmp_path: Path, damage: str) -> None:
    statements, words = DAMAGES[damage]
    path = changed_copy(sound, tmp_path / "damaged.db", *statements)
    before = sha256(path)
    with pytest.raises(DatabaseError) as caught:
        read_view_graph(path)
    message = str(caught.value)
    assert message.startswith(str(path)), message
    for word in words:
        assert word in message
    assert sha256(path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["damaged.db"]


def test_the_sound_database_is_read(sound: Path) -> None:
    assert read_view_graph(sound).num_edges == 6


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_that_is_cut_off_is_refused_or_read_but_never_a_crash(sound: Path, tmp_path: Path, share: float) -> None:
    content = sound.read_bytes()
    (tmp_path / "cut.db").write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatabaseError, match=r"cut\.db"):
        read_view_graph(tmp_path / "cut.db")


def test_random_bytes_in_the_file_never_crash(sound: Path, tmp_path: Path) -> None:
    content = np.frombuffer(sound.read_bytes(), dtype=np.uint8)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        damaged = content.copy()
        start = int(rng.integers(16, len(content) - 500))
        damaged[start : start + 500] = rng.integers(0, 256, 500)
        path = tmp_path / "noise.db"
        path.write_bytes(damaged.tobytes())
        try:
            graph = read_view_graph(path)
        except DatabaseError as error:
            assert str(error).startswith(str(path))  # noqa: PT017
        else:
            assert graph.num_images <= 4


# Nothing to map: read as it is, refused by the check


def test_a_database_without_images_is_an_empty_graph_and_no_job(tmp_path: Path) -> None:
    pycolmap.Database.open(tmp_path / "new.db").close()
    graph = read_view_graph(tmp_path / "new.db")
    assert (graph.num_images, graph.num_edges) == (0, 0)
    assert solve_view_graph(graph).status == SolutionStatus.UNSOLVABLE
    with pytest.raises(DatabaseError, match="no images; extract features first"):
        check_database(tmp_path / "new.db")


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM two_view_geometries",
        "UPDATE two_view_geometries SET rows = 0, data = NULL",
    ],
)
def test_images_without_verified_pairs_are_an_edgeless_graph_and_no_job(
    sound: Path, tmp_path: Path, statement: str
) -> None:
    path = changed_copy(sound, tmp_path / "unverified.db", statement)
    graph = read_view_graph(path)
    assert (graph.num_images, graph.num_edges) == (4, 0)
    assert solve_view_graph(graph).status == SolutionStatus.UNSOLVABLE
    with pytest.raises(DatabaseError, match="4 images but no verified pairs; match them first"):
        check_database(path)


def test_another_sqlite_file_is_no_colmap_database(sound: Path, tmp_path: Path) -> None:
    path = changed_copy(sound, tmp_path / "other.db", "DROP TABLE keypoints")
    for read in (read_view_graph, check_database):
        with pytest.raises(DatabaseError, match="not a COLMAP database, it has no table keypoints"):
            read(path)


def test_a_schema_that_is_no_text_is_named_whatever_sqlite_says_of_it(sound: Path, tmp_path: Path) -> None:
    path = tmp_path / "schema.db"
    content = sound.read_bytes()
    assert b"CREATE TABLE cameras" in content
    path.write_bytes(content.replace(b"CREATE TABLE cameras", b"CREATE TABL\xd6 \xd6ameras"))
    with pytest.raises(DatabaseError, match=r"schema\.db"):
        check_database(path)


def test_what_another_process_has_not_merged_yet_is_read(sound: Path, tmp_path: Path) -> None:
    """COLMAP writes in WAL mode: rows stand in DATABASE-wal until the last writer closes."""
    path = changed_copy(sound, tmp_path / "written.db", "PRAGMA journal_mode = WAL")
    with pycolmap.Database.open(path) as database:
        database.delete_two_view_geometry(1, 2)
        before = {p.name: sha256(p) for p in tmp_path.iterdir()}
        assert "written.db-wal" in before
        assert read_view_graph(path).num_edges == 5
        assert {p.name: sha256(p) for p in tmp_path.iterdir()} == before


def test_nothing_appears_beside_a_database_while_it_is_read(sound: Path, tmp_path: Path) -> None:
    path = changed_copy(sound, tmp_path / "written.db", "PRAGMA journal_mode = WAL")
    with reading(path) as connection:
        assert connection.execute("SELECT COUNT(*) FROM images").fetchone() == (4,)
        assert [p.name for p in tmp_path.iterdir()] == ["written.db"]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200, 1e-200])
@pytest.mark.parametrize("matrix", ["F", "E", "H"])
def test_a_matrix_beyond_numbers_is_as_good_as_none(sound: Path, tmp_path: Path, matrix: str, value: float) -> None:
    """The pose comes from the matches then."""
    content = np.full(9, value).tobytes()
    path = changed_copy(sound, tmp_path / "odd.db", (f"UPDATE two_view_geometries SET {matrix} = ?", (content,)))
    graph, expected = read_view_graph(path), read_view_graph(sound)
    assert (graph.read_verdicts == "kept").all()
    np.testing.assert_allclose(graph.cam2_from_cam1_rotations, expected.cam2_from_cam1_rotations, atol=1e-4)


def test_a_pair_that_repeats_one_match_is_read_without_a_pose(sound: Path, tmp_path: Path) -> None:
    """Its moments have rank one; the fundamental matrix refitted to them left the range of numbers."""
    match = np.tile(np.array([5, 5], dtype=np.uint32), (60, 1)).tobytes()
    path = changed_copy(
        sound, tmp_path / "odd.db", ("UPDATE two_view_geometries SET rows = 60, data = ? WHERE rowid = 1", (match,))
    )
    graph = read_view_graph(path)
    assert np.isfinite(graph.cam2_from_cam1_rotations).all()
    assert solve_view_graph(graph).registered.sum() >= 3


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM frame_data WHERE frame_id = 2",
        "DELETE FROM frames WHERE frame_id = 2",
        "UPDATE frame_data SET sensor_id = 9 WHERE frame_id = 2",
        "DELETE FROM rigs",
        "UPDATE frames SET rig_id = 77 WHERE frame_id = 2",
    ],
)
def test_rigs_and_frames_that_contradict_the_images_are_an_error_or_do_no_harm(
    sound: Path, tmp_path: Path, statement: str
) -> None:
    """pycolmap raises IndexError or ValueError on loading such a database, or aborts."""
    path = changed_copy(sound, tmp_path / "rigs.db", "PRAGMA foreign_keys = OFF", statement)
    try:
        models = view_graph_mapping(path, None, tmp_path / "out", MappingOptions(num_threads=1))
    except DatabaseError as error:
        assert not (tmp_path / "out").exists()
        assert "database" in str(error)  # noqa: PT017
    else:
        assert models[0].num_reg_images() >= 3


# Other processes


def test_a_database_that_another_process_locks_is_one_clear_error(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_vg.colmap_io.database.PATIENCE", 0.2)
    path = changed_copy(sound, tmp_path / "locked.db", "PRAGMA journal_mode = DELETE")
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(DatabaseError, match="another process is writing"):
            read_view_graph(path)
        other.execute("ROLLBACK")
    assert read_view_graph(path).num_edges == 6


def test_what_another_process_may_take_back_is_not_read(sound: Path, tmp_path: Path) -> None:
    """A large transaction reaches the file before it is committed; the journal beside it holds what was there."""
    path = changed_copy(sound, tmp_path / "spilled.db", "PRAGMA journal_mode = DELETE")
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA cache_size = 1")
        other.execute("PRAGMA cache_spill = 1")
        other.execute("BEGIN IMMEDIATE")
        other.execute("DELETE FROM two_view_geometries")
        other.execute("UPDATE keypoints SET data = zeroblob(length(data))")
        other.execute("UPDATE descriptors SET data = zeroblob(length(data))")
        assert (tmp_path / "spilled.db-journal").stat().st_size > 0
        before = {p.name: sha256(p) for p in tmp_path.iterdir()}
        assert read_view_graph(path).num_edges == 6
        assert {p.name: sha256(p) for p in tmp_path.iterdir()} == before
        other.execute("ROLLBACK")


def test_leftovers_of_a_killed_job_are_not_taken_for_changes(sound: Path, tmp_path: Path) -> None:
    """A -wal file beside a new copy would be merged into it."""
    other = changed_copy(sound, tmp_path / "other.db", "PRAGMA journal_mode = WAL")
    with pycolmap.Database.open(other) as database:
        database.clear_two_view_geometries()
        (tmp_path / "working_copy.db-wal").write_bytes((tmp_path / "other.db-wal").read_bytes())
    wal_mode = changed_copy(sound, tmp_path / "sound.db", "PRAGMA journal_mode = WAL")
    copy = working_copy(wal_mode, tmp_path)
    assert sorted(p.name for p in tmp_path.glob("working_copy.db*")) == ["working_copy.db"]
    assert read_view_graph(copy).num_edges == 6


def test_a_read_only_database_in_a_read_only_folder_is_read(sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    folder.mkdir()
    for mode in ("WAL", "DELETE"):
        path = changed_copy(sound, folder / f"{mode}.db", f"PRAGMA journal_mode = {mode}")
        path.chmod(0o444)
    folder.chmod(0o555)
    try:
        for path in sorted(folder.iterdir()):
            models = view_graph_mapping(path, None, tmp_path / path.stem, MappingOptions(num_threads=1))
            assert models[0].num_reg_images() == 4
        assert sorted(p.name for p in folder.iterdir()) == ["DELETE.db", "WAL.db"]
    finally:
        folder.chmod(0o755)
