"""Fisheyes whose focal length is unknown or wrong: it is found before any pose, and the pairs are verified with it."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from lens_rooms import NUM_IMAGES, WIDTH, camera, write_room
from synthetic_databases import centers

from colmap_vg import MappingOptions, ReadOptions, align_positions, read_view_graph
from colmap_vg.colmap_io.database import check_database
from colmap_vg.colmap_io.raw_matches import with_unverified_pairs
from colmap_vg.colmap_io.tables import UNDEFINED, read_tables
from colmap_vg.errors import DatabaseError
from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database
from colmap_vg.reading import fisheyes
from colmap_vg.reading.fisheyes import FOCALS_OVER_SIZE
from colmap_vg.reading.focals import decide_focal_lengths
from colmap_vg.reading.given_model import of_pairs

DISTORTIONS: dict[str, tuple[float, ...]] = {
    "SIMPLE_FISHEYE": (),
    "RADIAL_FISHEYE": (0.02, -0.004),
    "OPENCV_FISHEYE": (0.02, -0.004, 0.0, 0.0),
}


def true_focal(half_angle_deg: float) -> float:
    return 0.5 * WIDTH / float(np.radians(half_angle_deg))


def fisheye(model: str, focal: float, *, bent: bool, prior: bool = True) -> pycolmap.Camera:
    """A lens with the distortion of `DISTORTIONS`, or without any, as it is where nothing is known."""
    focals = (focal, focal) if model == "OPENCV_FISHEYE" else (focal,)
    distortion = DISTORTIONS[model] if bent else (0.0,) * len(DISTORTIONS[model])
    found = camera(model, (*focals, 600.0, 450.0, *distortion))
    found.has_prior_focal_length = prior
    return found


def write(path: Path, model: str, half_angle_deg: float, stored: pycolmap.Camera, seed: int = 0) -> np.ndarray:
    return write_room(path, fisheye(model, true_focal(half_angle_deg), bent=True), stored, seed=seed)


def check_is_right(path: Path, truth: np.ndarray, focal: float, out: Path) -> list[str]:
    log = StageLog()
    models = map_database(path, None, out, MappingOptions(num_threads=1), log).models
    ids = sorted(models[0].reg_image_ids())
    assert ids == list(range(1, NUM_IMAGES + 1))
    errors, _ = align_positions(centers(models[0], ids), truth)
    assert errors.mean() < 0.01 * 1.5  # of the ring's radius
    assert abs(models[0].camera(1).mean_focal_length() / focal - 1.0) < 0.03
    return log.warnings


@pytest.mark.parametrize(
    ("model", "half_angle_deg"),
    [("SIMPLE_FISHEYE", 30), ("OPENCV_FISHEYE", 45), ("RADIAL_FISHEYE", 60), ("OPENCV_FISHEYE", 80)],
)
def test_a_fisheye_is_mapped_with_nothing_given(model: str, half_angle_deg: float, tmp_path: Path) -> None:
    guess = fisheye(model, 1.2 * WIDTH, bent=False, prior=False)  # COLMAP's, which verifies no pair with it
    truth = write(tmp_path / "a.db", model, half_angle_deg, guess)
    assert not len(read_tables(tmp_path / "a.db").pairs)
    told = check_is_right(tmp_path / "a.db", truth, true_focal(half_angle_deg), tmp_path / "out")
    assert any("It is the initial focal length" in warning for warning in told)


@pytest.mark.parametrize("factor", [1.3, 1.0 / 1.3])
@pytest.mark.parametrize(("model", "seed"), [("OPENCV_FISHEYE", 0), ("SIMPLE_FISHEYE", 1)])
def test_a_wrong_focal_length_is_replaced(model: str, seed: int, factor: float, tmp_path: Path) -> None:
    stored = fisheye(model, factor * true_focal(30), bent=False)
    truth = write(tmp_path / "a.db", model, 30, stored, seed)
    told = check_is_right(tmp_path / "a.db", truth, true_focal(30), tmp_path / "out")
    assert any("the database" in warning and "% of the image pairs support" in warning for warning in told)
    assert not read_view_graph(tmp_path / "a.db").camera_focal_known.any()
    kept = read_view_graph(tmp_path / "a.db", ReadOptions(trust_focal_lengths="always"))
    assert kept.camera_focal_lengths[0] == stored.mean_focal_length()


@pytest.mark.parametrize("half_angle_deg", [30, 80])
def test_a_right_focal_length_is_kept(half_angle_deg: float, tmp_path: Path) -> None:
    stored = fisheye("OPENCV_FISHEYE", true_focal(half_angle_deg), bent=True)
    write(tmp_path / "a.db", "OPENCV_FISHEYE", half_angle_deg, stored)
    tables = read_tables(tmp_path / "a.db")
    assert fisheyes.with_found_fisheye_focals(tables, tmp_path / "a.db", ReadOptions())[0] is tables
    graph = read_view_graph(tmp_path / "a.db")
    assert graph.camera_focal_known.all()
    assert graph.camera_focal_lengths[0] == stored.mean_focal_length()


def test_a_given_calibration_is_kept_though_it_is_wrong(tmp_path: Path) -> None:
    write(tmp_path / "a.db", "SIMPLE_FISHEYE", 45, fisheye("SIMPLE_FISHEYE", 1000.0, bent=False))
    tables = read_tables(tmp_path / "a.db")
    found, changed = fisheyes.with_found_fisheye_focals(tables, tmp_path / "a.db", ReadOptions(), np.array([True]))
    assert found is tables
    assert not changed.any()
    found, changed = fisheyes.with_found_fisheye_focals(tables, tmp_path / "a.db", ReadOptions(), np.array([False]))
    assert changed.all()
    assert abs(found.cameras[0].mean_focal_length() / true_focal(45) - 1.0) < 0.03
    assert not found.cameras[0].has_prior_focal_length
    assert tables.cameras[0].mean_focal_length() == 1000.0
    assert np.isnan(found.E).all()


def test_false_matches_that_were_not_verified_do_no_harm(tmp_path: Path) -> None:
    guess = fisheye("SIMPLE_FISHEYE", 1.2 * WIDTH, bent=False, prior=False)
    write(tmp_path / "a.db", "SIMPLE_FISHEYE", 60, guess)
    rng = np.random.default_rng(0)
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection, connection:
        for pair_id, data in connection.execute("SELECT pair_id, data FROM matches").fetchall():
            matches = np.frombuffer(data, dtype=np.uint32).reshape(-1, 2).copy()
            wrong = np.flatnonzero(rng.random(len(matches)) < 0.4)
            matches[wrong, 1] = rng.permutation(matches[wrong, 1])
            connection.execute("UPDATE matches SET data = ? WHERE pair_id = ?", (matches.tobytes(), pair_id))
    found = read_view_graph(tmp_path / "a.db").camera_focal_lengths[0]
    assert found == pytest.approx(true_focal(60), rel=0.02)


@pytest.mark.parametrize("true_scale", [0.3, 0.8, 1.0, 1.37])
@pytest.mark.parametrize("prior", [True, False])
def test_the_search_ends_where_a_focal_length_votes_for_itself(true_scale: float, prior: bool) -> None:
    lens = fisheye("SIMPLE_FISHEYE", 1000.0, bent=False, prior=prior)
    tried = []

    def vote(scale: float) -> fisheyes._Vote:
        tried.append(scale)
        far = float(np.log(scale / true_scale))
        ratio = np.nan if far < -0.6 else -0.3 * far - 0.1 * far * abs(far)
        return fisheyes._Vote(ratio, max(0.8 - abs(far), 0.1))

    found = fisheyes._found_focal(lens, vote)
    if prior and true_scale == 1.0:
        assert found is None
        assert tried == [1.0]
        return
    assert found is not None
    assert abs(np.log(found[0] / true_scale)) < fisheyes.CONVERGED / 0.3
    assert found[2] > 0.7
    assert len(tried) <= 1 + len(fisheyes.FOCALS_OVER_SIZE) + fisheyes.MAX_NUM_STEPS


@pytest.mark.parametrize("true_scale", [0.7, 0.85, 1.0, 1.2])
def test_the_place_stays_bracketed_where_votes_jump(true_scale: float) -> None:
    lens = fisheye("SIMPLE_FISHEYE", 1000.0, bent=False, prior=False)

    def vote(scale: float) -> fisheyes._Vote:
        far = float(np.log(scale / true_scale))
        return fisheyes._Vote(float(-np.tanh(60.0 * far)) - 0.6, 0.5)

    found = fisheyes._found_focal(lens, vote)
    assert found is not None
    assert abs(np.log(found[0] / true_scale)) < 0.03


def test_a_vote_just_below_its_focal_length_is_where_it_falls() -> None:
    # As under the widest lenses, where shorter focal lengths have no rays.
    lens = fisheye("SIMPLE_FISHEYE", FOCALS_OVER_SIZE[2] * WIDTH, bent=False, prior=False)

    def vote(scale: float) -> fisheyes._Vote:
        far = float(np.log(scale))
        return fisheyes._Vote(np.nan if far < -1e-9 else -0.3 * far - 0.001, 0.5)

    found = fisheyes._found_focal(lens, vote)
    assert found is not None
    assert abs(np.log(found[0])) < 1e-9


def test_an_estimated_focal_length_is_kept_but_not_known(tmp_path: Path) -> None:
    lens = camera("SIMPLE_PINHOLE", (600.0, 600.0, 450.0))
    write_room(tmp_path / "a.db", lens, lens)
    tables = read_tables(tmp_path / "a.db")
    wrong = camera("SIMPLE_PINHOLE", (700.0, 600.0, 450.0))
    wrong.camera_id = 2
    of_camera = (np.arange(NUM_IMAGES) >= NUM_IMAGES // 2).astype(np.int64)
    tables = replace(tables, cameras=(lens, wrong), camera_idx=of_camera)
    voted = decide_focal_lengths(tables, ReadOptions())
    assert abs(voted.scales[1] - 6.0 / 7.0) < 0.02
    decided = decide_focal_lengths(tables, ReadOptions(), None, np.array([False, True]))
    assert decided.scales[1] == 1.0
    assert decided.known.tolist() == [True, False]


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_FISHEYE"])
def test_tables_without_pairs_are_returned(model: str, tmp_path: Path) -> None:
    lens = camera(model, (700.0, 600.0, 450.0))
    write_room(tmp_path / "a.db", lens, lens)
    tables = of_pairs((whole := read_tables(tmp_path / "a.db")), np.zeros(len(whole.pairs), dtype=bool))
    assert fisheyes.with_found_fisheye_focals(tables, tmp_path / "a.db", ReadOptions())[0] is tables


def test_fisheyes_of_which_nothing_can_be_told_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.db", "SIMPLE_FISHEYE", 45, fisheye("SIMPLE_FISHEYE", 1.2 * WIDTH, bent=False, prior=False))
    rng = np.random.default_rng(0)
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection, connection:
        for pair_id, rows in connection.execute("SELECT pair_id, rows FROM matches").fetchall():
            shuffled = np.stack([np.arange(rows), rng.permutation(rows)], axis=1).astype(np.uint32)
            connection.execute("UPDATE matches SET data = ? WHERE pair_id = ?", (shuffled.tobytes(), pair_id))
    check_database(tmp_path / "a.db")
    with pytest.raises(DatabaseError, match="fisheye cameras without a focal length"):
        read_view_graph(tmp_path / "a.db")
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection, connection:
        connection.execute("DELETE FROM matches")
    with pytest.raises(DatabaseError, match="no verified pairs"):
        check_database(tmp_path / "a.db")


def test_pairs_without_a_geometry_are_added_in_order(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    write(path, "SIMPLE_FISHEYE", 45, fisheye("SIMPLE_FISHEYE", true_focal(45), bent=False))
    whole = read_tables(path)
    refused = [3, 0, len(whole.pairs) - 1]
    with closing(sqlite3.connect(path)) as connection, connection:
        raw = {}
        for row in refused:
            pair_id = pycolmap.image_pair_to_pair_id(*whole.image_ids[whole.pairs[row]].tolist())
            connection.execute("UPDATE two_view_geometries SET rows = 0, data = x'' WHERE pair_id = ?", (pair_id,))
            (data,) = connection.execute("SELECT data FROM matches WHERE pair_id = ?", (pair_id,)).fetchone()
            raw[row] = np.frombuffer(data, dtype=np.uint32).reshape(-1, 2)
    part = read_tables(path)
    assert len(part.pairs) == len(whole.pairs) - 3
    found = with_unverified_pairs(part, path, np.ones(NUM_IMAGES, dtype=bool), 15)
    np.testing.assert_array_equal(found.pairs, whole.pairs)
    for row in range(len(whole.pairs)):
        own, same = (tables.matches[slice(*tables.offsets[row : row + 2])] for tables in (found, whole))
        np.testing.assert_array_equal(own, raw.get(row, same))
        assert found.configs[row] == (UNDEFINED if row in refused else whole.configs[row])
        np.testing.assert_array_equal(found.E[row], np.full((3, 3), np.nan) if row in refused else whole.E[row])
    assert len(with_unverified_pairs(part, path, np.arange(NUM_IMAGES) > 1, 15).pairs) < len(whole.pairs)
    assert with_unverified_pairs(part, path, np.ones(NUM_IMAGES, dtype=bool), 10_000) is part
