"""Scenes that fix less than they seem to: named outcomes, and never a wrong place."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import centers, make_database, pair_id, two_view_tracks_only, write_views

from colmap_vg import (
    ImageVerdict,
    SolutionStatus,
    align_positions,
    read_view_graph,
    solve_view_graph,
    view_graph_mapping,
)
from colmap_vg.errors import MappingError
from colmap_vg.geometry import so3

PLANAR_OR_PANORAMIC, CALIBRATED = 6, 2
POINTS = np.random.default_rng(0).uniform([-3, -2, 7], [3, 2, 9], (400, 3))


def poses(turns: np.ndarray, places: np.ndarray) -> list[pycolmap.Rigid3d]:
    rotations = so3.exp(np.asarray(turns, dtype=float))
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ p) for R, p in zip(rotations, places, strict=True)]


@pytest.mark.parametrize("links", [1, 2, 3])
def test_an_image_on_two_view_tracks_is_never_placed_wrongly(tmp_path: Path, links: int) -> None:
    path, leaf = tmp_path / "database.db", 12
    truth = make_database(path, num_images=12, num_points=400)
    two_view_tracks_only(path, leaf)
    with closing(sqlite3.connect(path)) as connection, connection:
        for other in range(links + 1, 12):
            for table in ("two_view_geometries", "matches"):
                connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (pair_id(other, leaf),))
    model = view_graph_mapping(path, None, tmp_path / "out")[0]
    ids = sorted(model.reg_image_ids())
    assert ids[:11] == list(range(1, 12))
    true = centers(truth, ids)
    radius = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    assert align_positions(centers(model, ids), true)[0].max() < 0.01 * radius
    solution = solve_view_graph(read_view_graph(path))
    if links == 1:
        assert solution.image_verdicts[leaf - 1] == ImageVerdict.NOT_RIGID


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
@pytest.mark.parametrize("config", [CALIBRATED, PLANAR_OR_PANORAMIC])
@pytest.mark.parametrize("turn", [0.0, 0.05])
def test_cameras_that_only_turn_or_stand_still_are_named(
    tmp_path: Path, noise_px: float, config: int, turn: float
) -> None:
    turns = np.outer(np.arange(8), [0.0, turn, 0.0])
    write_views(tmp_path / "a.db", poses(turns, np.zeros((8, 3))), POINTS, config, noise_px=noise_px)
    with pytest.raises(MappingError, match="rotated without moving"):
        view_graph_mapping(tmp_path / "a.db", None, tmp_path / "out")
    assert not (tmp_path / "out" / "0").exists()


@pytest.mark.parametrize("shake", [0.003, 0.01, 0.03])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_camera_that_all_but_turns_is_not_called_solved(tmp_path: Path, shake: float, seed: int) -> None:
    """Baselines of the noise's size: what is registered is near the truth, or the rest is named uncertain."""
    rng = np.random.default_rng(seed)
    turns, places = np.outer(np.arange(8), [0.0, 0.05, 0.0]), shake * rng.standard_normal((8, 3))
    write_views(tmp_path / "a.db", poses(turns, places), POINTS, CALIBRATED, noise_px=0.5)
    solution = solve_view_graph(read_view_graph(tmp_path / "a.db"))
    rows = np.flatnonzero(solution.registered)
    if solution.status == SolutionStatus.SOLVED:
        errors, _ = align_positions(solution.projection_centers[rows], places[rows])
        assert errors.mean() < 0.15 * np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))
    else:
        left = set(solution.image_verdicts[~solution.registered])
        assert left <= {ImageVerdict.UNCERTAIN, ImageVerdict.NOT_RIGID, ImageVerdict.NO_EDGES}


@pytest.mark.parametrize("step", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.3)])
@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_cameras_on_a_rail_keep_their_distances(tmp_path: Path, step: tuple[float, ...], noise_px: float) -> None:
    places = np.outer(np.arange(10), step)
    write_views(tmp_path / "a.db", poses(np.zeros((10, 3)), places), POINTS, CALIBRATED, noise_px=noise_px)
    solution = solve_view_graph(read_view_graph(tmp_path / "a.db"))
    assert solution.registered.all()
    # Before any point: directions alone leave the distances along a line open.
    assert align_positions(solution.projection_centers, places)[0].max() < (1e-5 if noise_px == 0 else 0.02)
    model = view_graph_mapping(tmp_path / "a.db", None, tmp_path / "out")[0]
    errors, _ = align_positions(centers(model, list(range(1, 11))), places)
    assert errors.max() < (1e-5 if noise_px == 0 else 0.02)
