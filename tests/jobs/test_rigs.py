"""Jobs on rigs of several cameras: beside pycolmap's mappers, with known and unknown places, and from photographs."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rig_scenes import RIGHT, RIGHT_CENTER, errors, keep_pairs, make_rigs, render_rig
from typer.testing import CliRunner

from colmap_vg import ColmapVgError, MappingOptions, align_positions, read_view_graph, view_graph_mapping
from colmap_vg.cli.main import app
from colmap_vg.colmap_io.database import check_database
from colmap_vg.errors import DatabaseError
from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database

ONE_THREAD = MappingOptions(num_threads=1, extract_colors=False)


def known_poses(model: pycolmap.Reconstruction) -> list[np.ndarray]:
    rigs = [rig for _, rig in sorted(model.rigs.items())]
    return [rig.sensor_from_rig(s).matrix() for rig in rigs for s in rig.non_ref_sensors]


@pytest.mark.parametrize(("rigs", "cameras", "frames"), [(1, 2, 8), (2, 3, 5), (3, 4, 4)])
@pytest.mark.parametrize("known", [True, False])
def test_all_images_are_registered_as_well_as_by_the_better_mapper(
    tmp_path: Path, rigs: int, cameras: int, frames: int, known: bool
) -> None:
    path = tmp_path / "database.db"
    truth = make_rigs(path, rigs, cameras, frames, known, spacing=0.1, inlier_ratio=0.8)
    models = view_graph_mapping(path, None, tmp_path / "ours", ONE_THREAD)
    assert models[0].num_reg_images() == truth.num_images()
    error, scale = errors(models[0], truth)
    others = []
    for name in ("global_mapping",) if not known else ("global_mapping", "incremental_mapping"):
        copy = Path(shutil.copyfile(path, tmp_path / f"{name}.db"))
        (tmp_path / name).mkdir()
        others.append(errors(getattr(pycolmap, name)(copy, tmp_path, tmp_path / name)[0], truth)[0])
    assert error <= 1.05 * min(others)
    if known:
        assert scale == pytest.approx(1.0, abs=0.02)
        for own, true in zip(known_poses(models[0]), known_poses(truth), strict=True):
            np.testing.assert_allclose(own, true, atol=1e-15)  # they are not adjusted


def test_a_written_model_holds_frames_and_rigs(tmp_path: Path) -> None:
    truth = make_rigs(tmp_path / "database.db", known=False)
    view_graph_mapping(tmp_path / "database.db", None, tmp_path / "out", ONE_THREAD)
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert model.num_reg_frames() == 8
    assert model.num_reg_images() == 16
    own, true = known_poses(model)[0], known_poses(truth)[0]
    _, scale = errors(model, truth)
    np.testing.assert_allclose(own[:, :3], true[:, :3], atol=5e-3)
    np.testing.assert_allclose(scale * own[:, 3], true[:, 3], atol=0.02)


def test_cameras_without_a_common_pair_are_linked_by_their_rig(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = make_rigs(path, num_frames=10)
    keep_pairs(path, "a == b")
    log = StageLog()
    models = map_database(path, None, tmp_path / "out", ONE_THREAD, log).models
    assert models[0].num_reg_images() == 20
    error, scale = errors(models[0], truth)
    assert error < 0.004
    assert scale == pytest.approx(1.0, abs=0.01)
    assert log.warnings == ["10 images are linked to the others by their rig alone: no pair confirms their place."]


def test_unknown_places_do_not_link_cameras(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = make_rigs(path, num_frames=10, known=False)
    keep_pairs(path, "a == b")
    log = StageLog()
    models = map_database(path, None, tmp_path / "out", ONE_THREAD, log).models
    assert sorted(model.num_reg_images() for model in models.values()) == [10, 10]
    assert log.warnings[0].startswith("The places of 1 cameras in their rig are not known, and no frame tells them")
    for model in models.values():
        assert errors(model, truth)[0] < 0.004


def test_frames_place_images_without_pairs(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = make_rigs(path)
    keep_pairs(path, "a == 1 and b == 1")
    log = StageLog()
    models = map_database(path, None, tmp_path / "out", ONE_THREAD, log).models
    assert models[0].num_reg_images() == 16
    for image_id in models[0].reg_image_ids():
        turns = [m.image(image_id).cam_from_world().rotation.matrix() for m in (models[0], truth)]
        first = [m.image(1).cam_from_world().rotation.matrix() for m in (models[0], truth)]
        own, true = (turn @ one.T for turn, one in zip(turns, first, strict=True))
        np.testing.assert_allclose(own, true, atol=5e-3)
    # The first camera alone tells the frames, but not the scale.
    assert any("do not tell the model's scale" in warning for warning in log.warnings)


def test_the_graph_holds_rigs_where_there_are_any(tmp_path: Path) -> None:
    make_rigs(tmp_path / "rigs.db", num_rigs=2, num_cameras=3, num_frames=4)
    rigs = read_view_graph(tmp_path / "rigs.db").rigs
    assert rigs is not None
    assert (rigs.num_frames, rigs.num_sensors) == (8, 6)
    assert rigs.known.all()
    assert rigs.is_metric
    assert np.bincount(rigs.frame_idx).tolist() == [3] * 8
    make_rigs(tmp_path / "none.db", num_cameras=1, num_frames=6)
    assert read_view_graph(tmp_path / "none.db").rigs is None


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("UPDATE rig_sensors SET sensor_from_rig = x'0011'", "sensor 2 of rig 1: its pose is damaged"),
        ("DELETE FROM frame_data WHERE data_id = 3", "image 3 is in no frame of a rig with its camera"),
    ],
)
def test_damaged_rigs_are_named(tmp_path: Path, statement: str, told: str) -> None:
    path = tmp_path / "database.db"
    make_rigs(path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(statement)
    check_database(path)
    with pytest.raises(DatabaseError, match=told):
        read_view_graph(path)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    folder = tmp_path_factory.mktemp("rig") / "photographs"
    return folder, render_rig(folder)


def config(cameras: list[dict[str, object]]) -> str:
    return json.dumps([{"cameras": cameras}])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folders", "file"])
def test_from_photographs(photographs: tuple[Path, np.ndarray], tmp_path: Path, kind: str) -> None:
    folder, truth = photographs
    flags = ["--rigs", "folders"]
    if kind == "file":
        x, y, z, w = pycolmap.Rotation3d(RIGHT).quat
        place = (-RIGHT @ RIGHT_CENTER).tolist()
        right = {"image_prefix": "right/", "cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": place}
        (tmp_path / "rig_config.json").write_text(config([{"image_prefix": "left/", "ref_sensor": True}, right]))
        flags = ["--rig_config_path", str(tmp_path / "rig_config.json")]
    job = ["run", "--image_path", str(folder), "--output_path", str(tmp_path / "out"), *flags]
    result = CliRunner().invoke(app, job)
    assert result.exit_code == 0, result.output
    assert "1 rigs with 2 cameras, 7 frames" in result.output
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert model.num_reg_frames() == 7
    assert model.num_reg_images() == 14
    by_name = {image.name: image.projection_center() for image in model.images.values()}
    own = np.array([by_name[f"{side}/{k:04d}.jpg"] for side in ("left", "right") for k in range(7)])
    distances, similarity = align_positions(own, truth)
    assert distances.mean() < 0.02
    if kind == "file":
        assert similarity.scale == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--rig_config_path", "missing.json"], "cannot read the rig configuration missing.json"),
        (["--rig_config_path", "missing.json", "--rigs", "folders"], "exclude each other"),
    ],
)
def test_wrong_configurations_are_told_before_work_starts(tmp_path: Path, flags: list[str], told: str) -> None:
    result = CliRunner().invoke(
        app, ["run", "--image_path", "photographs", "--output_path", str(tmp_path / "o"), *flags]
    )
    assert result.exit_code in (1, 2)
    assert told in result.stderr


def test_folders_without_common_names_are_no_rig() -> None:
    from colmap_vg.features.rigs import rigs_of_folders

    with pytest.raises(ColmapVgError, match="no name occurs in two of the 2 folders"):
        rigs_of_folders(["a/1.jpg", "b/2.jpg"])
    with pytest.raises(ColmapVgError, match="found 1 folder"):
        rigs_of_folders(["a/1.jpg", "a/2.jpg"])
    with pytest.raises(ColmapVgError, match="and 1 photographs in none"):
        rigs_of_folders(["a/1.jpg", "b/1.jpg", "c.jpg"])
    (rig,) = rigs_of_folders(["b/1.jpg", "a/1.jpg", "a/2.jpg"])
    assert [(camera.image_prefix, camera.ref_sensor) for camera in rig.cameras] == [("a/", True), ("b/", False)]
