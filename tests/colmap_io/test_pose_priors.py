"""Pose priors of a database: frames, covariances, gravity, and what is not taken."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from measured_positions import by_gps, east_north_up, prior, write_priors
from synthetic_databases import changed_copy, make_database, sha256

from colmap_vg import read_view_graph
from colmap_vg.colmap_io.pose_priors import read_pose_priors
from colmap_vg.errors import DatabaseError, GraphError
from colmap_vg.scene.pose_priors import PosePriors

IDS = tuple(range(1, 7))


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("priors") / "database.db"
    make_database(path, num_images=6, num_points=60)
    return path


@pytest.fixture
def database_path(empty: Path, tmp_path: Path) -> Path:
    return Path(shutil.copyfile(empty, tmp_path / "database.db"))


def read(path: Path) -> PosePriors:
    priors, caveats = read_pose_priors(path, IDS)
    assert caveats == ()
    assert priors is not None
    return priors


def test_gps_positions_are_metres_east_north_and_up(database_path: Path) -> None:
    places = by_gps(np.random.default_rng(0).uniform(-500, 500, (6, 3)))
    write_priors(database_path, [prior(i, place, "WGS84", 2.0) for i, place in zip(IDS, places, strict=True)])
    before = sha256(database_path)
    found = read(database_path)
    assert sha256(database_path) == before
    assert found.origin is not None
    expected = [east_north_up(*place, found.origin) for place in places]
    np.testing.assert_allclose(found.positions, expected, atol=1e-5)
    np.testing.assert_allclose(found.covariances, np.broadcast_to(4.0 * np.eye(3), (6, 3, 3)))
    assert np.abs(found.positions.mean(axis=0)).max() < 500.0  # the origin is among them
    assert not found.has_gravity.any()


def test_cartesian_positions_are_left_as_they_are(database_path: Path) -> None:
    places = np.arange(18.0).reshape(6, 3)
    write_priors(database_path, [prior(i, place) for i, place in zip(IDS[:4], places[:4], strict=True)])
    found = read(database_path)
    assert found.origin is None
    np.testing.assert_array_equal(found.positions[:4], places[:4])
    assert found.has_position.tolist() == [True] * 4 + [False] * 2
    assert np.isnan(found.covariances).all()


def test_gravity_counts_where_it_was_measured(database_path: Path) -> None:
    down = np.array([0.1, 0.9, -0.3])
    rows = [prior(i, np.full(3, np.nan)) for i in IDS[:3]]
    for row, gravity in zip(rows, (2.0 * down, [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]), strict=True):
        row.gravity = gravity
    write_priors(database_path, rows)
    found = read(database_path)
    assert found.has_gravity.tolist() == [True] + [False] * 5  # the others are photographs' orientations
    np.testing.assert_allclose(found.gravities[0], down / np.linalg.norm(down))
    assert not found.has_position.any()


@pytest.mark.parametrize(
    ("position", "system"),
    [
        ((0.0, 0.0, 10.0), "WGS84"),
        ((95.0, 8.0, 0.0), "WGS84"),
        ((1.0, 2.0, 3.0), "UNDEFINED"),
        ((1, 2, 3), "CARTESIAN"),
    ],
)
def test_positions_that_are_none_are_ignored_and_counted(
    database_path: Path, position: tuple[float, float, float], system: str
) -> None:
    good = by_gps(np.random.default_rng(0).uniform(-50, 50, (5, 3)))
    rows = [prior(i, place, "WGS84") for i, place in zip(IDS[:5], good, strict=True)]
    write_priors(database_path, [*rows, prior(6, np.array(position), system)])
    priors, caveats = read_pose_priors(database_path, IDS)
    assert priors is not None
    assert priors.has_position.tolist() == [True] * 5 + [False]
    assert [caveat[:22] for caveat in caveats] == ["1 of 6 position priors"]


def test_covariances_that_are_none_count_as_unknown(database_path: Path) -> None:
    rows = [prior(i, np.array([i, 0.0, 0.0]), sigma=1.0) for i in IDS]
    rows[0].position_covariance = -np.eye(3)
    rows[1].position_covariance = np.zeros((3, 3))
    rows[2].position_covariance = np.triu(np.ones((3, 3)))
    write_priors(database_path, rows)
    assert np.isfinite(read(database_path).covariances).all(axis=(1, 2)).tolist() == [False] * 3 + [True] * 3


def test_without_priors_there_are_none(empty: Path, database_path: Path) -> None:
    assert read_pose_priors(empty, IDS) == (None, ())
    write_priors(database_path, [prior(1, np.full(3, np.nan))])
    assert read_pose_priors(database_path, IDS) == (None, ())
    dropped = changed_copy(empty, database_path, "DROP TABLE pose_priors")
    assert read_pose_priors(dropped, IDS) == (None, ())


def test_the_older_schema_is_read(empty: Path, database_path: Path) -> None:
    columns = (
        "image_id INTEGER PRIMARY KEY NOT NULL, position BLOB, coordinate_system INTEGER, position_covariance BLOB"
    )
    changed_copy(empty, database_path, "DROP TABLE pose_priors", f"CREATE TABLE pose_priors ({columns})")
    with closing(sqlite3.connect(database_path)) as connection, connection:
        blob = np.array([1.0, 2.0, 3.0]).tobytes()
        connection.execute("INSERT INTO pose_priors VALUES (3, ?, 1, NULL)", (blob,))
    found = read(database_path)
    np.testing.assert_array_equal(found.positions[2], [1.0, 2.0, 3.0])
    assert found.has_position.sum() == 1


def test_a_damaged_row_is_named(database_path: Path) -> None:
    write_priors(database_path, [prior(i, np.array([1.0, 2.0, 3.0])) for i in IDS])
    damaged = changed_copy(
        database_path,
        database_path.with_name("damaged.db"),
        "UPDATE pose_priors SET position = x'00' WHERE corr_data_id = 4",
    )
    with pytest.raises(DatabaseError, match=r"damaged\.db: position of image 4: damaged"):
        read_view_graph(damaged)


def test_the_graph_holds_them(database_path: Path) -> None:
    write_priors(database_path, [prior(2, np.array([1.0, 2.0, 3.0]))])
    graph = read_view_graph(database_path)
    assert graph.priors is not None
    assert graph.image_ids[graph.priors.has_position].tolist() == [2]


def test_arrays_of_other_shapes_are_refused() -> None:
    with pytest.raises(GraphError, match=r"covariances has shape \(2, 3\)"):
        PosePriors(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)))


def test_priors_of_colmaps_own_synthetic_data(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=5, prior_position=True, prior_gravity=True, num_points3D=20
    )
    options.prior_position_coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
        ids = sorted(image.image_id for image in truth.images.values())
    priors, _ = read_pose_priors(tmp_path / "database.db", ids)
    assert priors is not None
    centers = np.array([truth.image(i).projection_center() for i in ids])
    # The synthetic frame is that of another origin, metres away: nearly a translation.
    shift = priors.positions - centers
    assert np.abs(shift - shift.mean(axis=0)).max() < 1e-3
    down = np.array([truth.image(i).cam_from_world().rotation.matrix() @ [0.0, 1.0, 0.0] for i in ids])
    np.testing.assert_allclose(priors.gravities, down, atol=1e-9)
