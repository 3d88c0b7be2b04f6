"""Jobs that start from a model: its cameras stay, the other images are added as a joint job would place them."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rig_scenes import make_rigs
from typer.testing import CliRunner

from colmap_vg import MappingOptions, align_positions, view_graph_mapping
from colmap_vg.cli.main import app
from colmap_vg.colmap_io.reconstruction import loaded_cache
from colmap_vg.errors import DataFileError
from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.jobs.mapper import map_database
from colmap_vg.mapping import build, extension
from colmap_vg.mapping.build import finish_registration
from colmap_vg.mapping.options import triangulator_options
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import FOCAL_PX, HEIGHT, WIDTH, SyntheticViews, synthetic_views

OPTIONS = MappingOptions(num_threads=1, extract_colors=False)
NEW = (3, 8, 13, 18, 23)
"""Ids of the images that are added."""
MAX_NUM_IMAGES = 2_147_483_647


def without_images(path: Path, target: Path, ids: tuple[int, ...]) -> Path:
    """A copy of a database without some images."""
    shutil.copyfile(path, target)
    with closing(sqlite3.connect(target)) as connection, connection:
        for table in ("two_view_geometries", "matches"):
            for (pair,) in connection.execute(f"SELECT pair_id FROM {table}").fetchall():
                if pair // MAX_NUM_IMAGES in ids or pair % MAX_NUM_IMAGES in ids:
                    connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (pair,))
        for image_id in ids:
            connection.execute("DELETE FROM images WHERE image_id = ?", (image_id,))
            connection.execute("DELETE FROM keypoints WHERE image_id = ?", (image_id,))
            connection.execute("DELETE FROM frame_data WHERE data_id = ?", (image_id,))
        connection.execute("DELETE FROM frames WHERE frame_id NOT IN (SELECT frame_id FROM frame_data)")
    return target


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``all.db`` of 25 images, the model ``old`` of 20 of them, and the model ``joint`` of all."""
    folder = tmp_path_factory.mktemp("extension")
    write_synthetic_database(folder / "all.db", synthetic_views("drone", 25, noise_px=0.5))
    part = without_images(folder / "all.db", folder / "part.db", NEW)
    view_graph_mapping(part, None, folder / "old", OPTIONS)
    view_graph_mapping(folder / "all.db", None, folder / "joint", OPTIONS)
    return folder


def poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {model.image(i).name: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}


def centers(model: pycolmap.Reconstruction, names: list[str]) -> np.ndarray:
    by_name = {model.image(i).name: model.image(i).projection_center() for i in model.reg_image_ids()}
    return np.array([by_name[name] for name in names])


def radius(points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


@pytest.mark.parametrize("fixed", [True, False])
def test_old_poses_stay_and_new_ones_are_as_of_a_joint_job(scene: Path, tmp_path: Path, fixed: bool) -> None:
    old, joint = pycolmap.Reconstruction(scene / "old" / "0"), pycolmap.Reconstruction(scene / "joint" / "0")
    log = StageLog()
    options = replace(OPTIONS, fix_existing_frames=fixed)
    result = map_database(scene / "all.db", None, tmp_path / "out", options, log, scene / "old" / "0")
    model = result.models[0]
    assert log.warnings == []
    assert [record.stage for record in log.records] == ["view graph", "load", "extend", "register", "check", "write"]
    assert (old.num_reg_images(), model.num_reg_images()) == (20, 25)
    before, after = poses(old), poses(model)
    if fixed:
        for name, pose in before.items():
            np.testing.assert_allclose(after[name], pose, atol=1e-9)
    names = sorted(before)
    moved = np.linalg.norm(centers(model, names) - centers(old, names), axis=1)
    assert moved.max() < 1e-3 * radius(centers(old, names))
    new = sorted(set(after) - set(before))
    assert len(new) == 5
    distances, _ = align_positions(centers(model, names + new), centers(joint, names + new))
    assert distances[-5:].max() < 1e-3 * radius(centers(joint, names + new))
    assert result.solution.registered.all()
    assert result.solution.agreement[0].inliers > 0.95
    assert model.num_points3D() > old.num_points3D()
    written = pycolmap.Reconstruction(tmp_path / "out" / "0")
    np.testing.assert_allclose(centers(written, names + new), centers(model, names + new))


def test_a_model_of_other_keypoints_gives_its_poses_only(scene: Path, tmp_path: Path) -> None:
    """As one that was made with other features: its points are triangulated anew."""
    old, bare = pycolmap.Reconstruction(scene / "old" / "0"), pycolmap.Reconstruction()
    bare.add_camera_with_trivial_rig(pycolmap.Camera(old.camera(1).todict()))
    for image_id in old.reg_image_ids():
        image = pycolmap.Image(name=old.image(image_id).name, camera_id=1, image_id=image_id)
        bare.add_image_with_trivial_frame(image, old.image(image_id).cam_from_world())
    (tmp_path / "bare").mkdir()
    bare.write(tmp_path / "bare")
    models = view_graph_mapping(scene / "all.db", None, tmp_path / "out", OPTIONS, input_path=tmp_path / "bare")
    assert models[0].num_reg_images() == 25
    joint = pycolmap.Reconstruction(scene / "joint" / "0")
    names = sorted(poses(joint))
    distances, _ = align_positions(centers(models[0], names), centers(joint, names))
    assert distances.max() < 1e-3 * radius(centers(joint, names))


def test_images_with_many_points_are_registered_by_a_sample(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extension, "NUM_OBSERVATIONS_TO_REGISTER", 60)
    given, left, register = list[int](), list[set[int]](), build._register_left_out

    def register_left_out(*arguments: object) -> set[int]:
        left.append(register(*arguments))
        return left[-1]

    def finish(mapper, options, log, pairs, held, kept, placed):
        given.extend(sorted(placed))
        return finish_registration(mapper, options, log, pairs, held, kept, placed)

    monkeypatch.setattr(extension, "finish_registration", finish)
    monkeypatch.setattr(build, "_register_left_out", register_left_out)
    models = view_graph_mapping(scene / "all.db", None, tmp_path / "out", OPTIONS, input_path=scene / "old" / "0")
    assert given == list(NEW)
    assert left == [set(), set()]
    joint = pycolmap.Reconstruction(scene / "joint" / "0")
    names = sorted(poses(joint))
    distances, _ = align_positions(centers(models[0], names), centers(joint, names))
    assert distances.max() < 1e-3 * radius(centers(joint, names))


def test_a_model_is_part_of_another_by_ids_names_and_keypoints(scene: Path) -> None:
    old, joint = (pycolmap.Reconstruction(scene / name / "0") for name in ("old", "joint"))
    assert extension._is_part_of(old, joint)
    assert not extension._is_part_of(joint, old)
    old.image(1).name = "other.jpg"
    assert not extension._is_part_of(old, joint)


@pytest.mark.parametrize("num_cameras", [1, 2])
def test_a_sample_of_points_tells_poses_and_calibrations_of_new_rigs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, num_cameras: int
) -> None:
    monkeypatch.setattr(extension, "NUM_OBSERVATIONS_TO_REGISTER", 100)
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=num_cameras, num_frames_per_rig=6, num_points3D=300
    )
    options.camera_has_prior_focal_length = False
    with pycolmap.Database.open(tmp_path / "all.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    model, new = pycolmap.Reconstruction(truth), list(range(7, 13))
    for frame_id in new:
        model.deregister_frame(frame_id)
    if num_cameras == 1:
        model.camera(2).params = (model.camera(2).params * [1.1, 1.0, 1.0, 1.0]).tolist()
    found = extension._registered_by_sample(cache, model, OPTIONS)
    assert sorted(found) == new
    for frame_id, pose in found.items():
        np.testing.assert_allclose(pose.matrix(), truth.frame(frame_id).rig_from_world.matrix(), atol=1e-4)
    assert model.num_reg_frames() == 6
    for camera_id, camera in truth.cameras.items():
        np.testing.assert_allclose(model.camera(camera_id).params, camera.params, rtol=1e-4)


def test_rigs_of_other_reference_sensors_or_unknown_places_differ() -> None:
    def of_rig(reference: int, other: int, place: pycolmap.Rigid3d | None = None) -> pycolmap.Reconstruction:
        model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
        for camera_id in (1, 2):
            model.add_camera(pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_PINHOLE", 500.0, 640, 480))
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, reference))
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, other), place)
        model.add_rig(rig)
        return model

    models = [of_rig(1, 2), of_rig(2, 1)]
    assert [extension._is_part_of(a, b) for a in models for b in models] == [True, False, False, True]
    known = of_rig(1, 2, pycolmap.Rigid3d())
    assert extension._is_part_of(known, models[0])
    assert not extension._is_part_of(models[0], known)


def test_a_model_with_other_rigs_is_no_part_of_another() -> None:
    def two_images(num_cameras: int) -> pycolmap.Reconstruction:
        """Two images of one rig and frame, or of a rig and a frame each."""
        return pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=3 - num_cameras, num_cameras_per_rig=num_cameras, num_frames_per_rig=1, num_points3D=5
            )
        )

    models = [two_images(1), two_images(2)]
    for model in models:
        for image_id in (1, 2):
            model.image(image_id).name = str(image_id)
            for keypoint in model.image(image_id).points2D:
                keypoint.xy = np.zeros(2)
    assert [extension._is_part_of(a, b) for a in models for b in models] == [True, False, False, True]


@pytest.mark.parametrize("shift_px", [0.0, 3.0])
def test_points_of_a_model_are_copied_if_its_keypoints_are_the_same(
    scene: Path, tmp_path: Path, shift_px: float
) -> None:
    old = pycolmap.Reconstruction(scene / "old" / "0")
    for image_id in old.reg_image_ids():
        for keypoint in old.image(image_id).points2D:
            keypoint.xy = keypoint.xy + shift_px
    (tmp_path / "given").mkdir()
    old.write(tmp_path / "given")
    told: list[str] = []
    view_graph_mapping(
        scene / "all.db",
        None,
        tmp_path / "out",
        OPTIONS,
        lambda e: told.append(e.message),
        input_path=tmp_path / "given",
    )
    copied = old.num_points3D() if shift_px == 0.0 else 0
    assert any(f"20 images and {copied} points of the given model" in message for message in told)


def test_ids_of_the_model_need_not_be_those_of_the_database(scene: Path, tmp_path: Path) -> None:
    """Names are what counts, also for the tracks of its points."""
    old = pycolmap.Reconstruction(scene / "old" / "0")
    folder = tmp_path / "renumbered"
    folder.mkdir()
    old.write_text(folder)
    for name in ("rigs.txt", "frames.txt"):
        (folder / name).unlink()
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if not line.startswith("#")]
    heads = [line.split(" ", 1) for line in lines[::2]]
    renumbered = [f"{int(number) + 100} {rest}" for number, rest in heads]
    (folder / "images.txt").write_text("".join(f"{a}\n{b}\n" for a, b in zip(renumbered, lines[1::2], strict=True)))
    points = [line.split() for line in (folder / "points3D.txt").read_text().splitlines() if not line.startswith("#")]
    for words in points:
        words[8::2] = [str(int(word) + 100) for word in words[8::2]]
    (folder / "points3D.txt").write_text("".join(" ".join(words) + "\n" for words in points))
    model = view_graph_mapping(scene / "all.db", None, tmp_path / "out", OPTIONS, input_path=folder)[0]
    assert model.num_reg_images() == 25
    assert model.num_points3D() > old.num_points3D()
    assert model.compute_mean_reprojection_error() < 1.0
    assert model.compute_mean_track_length() > old.compute_mean_track_length()


def known_poses(folder: Path, views: SyntheticViews, sigma: float, names: range, width: int = WIDTH) -> Path:
    """A text model of poses only, turned by `sigma` radians and shifted by 10 `sigma` metres, along each axis."""
    rng = np.random.default_rng(0)
    lines = []
    for k in names:
        R = so3.exp(sigma * rng.standard_normal((1, 3)))[0] @ views.cam_from_world_rotations[k]
        center = views.projection_centers[k] + 10.0 * sigma * rng.standard_normal(3)
        x, y, z, w = pycolmap.Rotation3d(R).quat
        lines.append(" ".join(map(str, [k + 1, w, x, y, z, *(-R @ center), 1, f"{k:05d}.jpg\n\n"])))
    folder.mkdir()
    (folder / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE {width} {HEIGHT} {FOCAL_PX} {width / 2} {HEIGHT / 2}\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
    return folder


@pytest.mark.parametrize("num_known", [25, 20])
def test_rough_known_poses_are_adjusted(scene: Path, tmp_path: Path, num_known: int) -> None:
    """As from an inertial sensor or a simulator, written as a text model: poses are 1 degree off."""
    views = synthetic_views("drone", 25, noise_px=0.5)
    known, log = known_poses(tmp_path / "known", views, 0.02, range(num_known)), StageLog()
    options = replace(OPTIONS, fix_existing_frames=False)
    result = map_database(scene / "all.db", None, tmp_path / "out", options, log, known)
    assert result.solution.registered.all()
    names = [f"{k:05d}.jpg" for k in range(25)]
    of_result, of_joint = (
        align_positions(centers(model, names), views.projection_centers)[0].mean()
        for model in (result.models[0], pycolmap.Reconstruction(scene / "joint" / "0"))
    )
    assert of_result < 1.1 * of_joint
    given = centers(pycolmap.Reconstruction(known), names[:num_known])
    moved = centers(result.models[0], names[:num_known]) - given
    assert np.linalg.norm(moved.mean(axis=0)) < 0.01  # in the frame of the given poses
    assert any("The given model explains only" in warning for warning in log.warnings)


def test_rough_known_poses_that_are_kept_get_no_points_that_do_not_fit(scene: Path, tmp_path: Path) -> None:
    known, log = (
        known_poses(tmp_path / "known", synthetic_views("drone", 25, noise_px=0.5), 0.02, range(25)),
        StageLog(),
    )
    model = map_database(scene / "all.db", None, tmp_path / "out", OPTIONS, log, known).models[0]
    assert any("The given model explains only" in warning for warning in log.warnings)
    assert model.compute_mean_reprojection_error() < 4.0


def test_exact_known_poses_are_kept(scene: Path, tmp_path: Path) -> None:
    views, log = synthetic_views("drone", 25, noise_px=0.5), StageLog()
    known = known_poses(tmp_path / "known", views, 0.0, range(25))
    model = map_database(scene / "all.db", None, tmp_path / "out", OPTIONS, log, known).models[0]
    assert log.warnings == []
    np.testing.assert_allclose(centers(model, ["00007.jpg"])[0], views.projection_centers[7], atol=1e-9)
    assert model.num_points3D() > 3000
    assert model.compute_mean_reprojection_error() < 1.0
    with loaded_cache(scene / "all.db", tmp_path, 15) as (cache, _):
        mapper, count = pycolmap.IncrementalMapper(cache), model.compute_num_observations()
        mapper.begin_reconstruction(model)
        mapper.complete_and_merge_tracks(triangulator_options(OPTIONS))
    assert model.compute_num_observations() - count < 0.001 * count  # tracks are complete: 0.006 were missing


def test_calibrations_of_another_image_size_are_refused(scene: Path, tmp_path: Path) -> None:
    known = known_poses(tmp_path / "known", synthetic_views("drone", 25), 0.0, range(25), width=800)
    with pytest.raises(DataFileError, match="800 x 1200 pixels in the given model, 1600 x 1200 in the database"):
        map_database(scene / "all.db", None, tmp_path / "out", OPTIONS, StageLog(), known)


def test_images_that_do_not_belong_are_left_out_with_a_reason(scene: Path, tmp_path: Path) -> None:
    lone = tmp_path / "lone.db"
    shutil.copyfile(scene / "all.db", lone)
    with closing(sqlite3.connect(lone)) as connection, connection:
        for (pair,) in connection.execute("SELECT pair_id FROM two_view_geometries").fetchall():
            if 13 in (pair // MAX_NUM_IMAGES, pair % MAX_NUM_IMAGES):
                connection.execute("DELETE FROM two_view_geometries WHERE pair_id = ?", (pair,))
    result = map_database(lone, None, tmp_path / "out", OPTIONS, StageLog(), scene / "old" / "0")
    row = result.solution.image_ids.tolist().index(13)
    assert result.solution.image_verdicts[row] == "no_edges"
    assert result.models[0].num_reg_images() == 24
    assert result.solution.status == "partial"


@pytest.mark.parametrize("known", [True, False])
def test_rigs_are_extended_by_frames(tmp_path: Path, known: bool) -> None:
    truth = make_rigs(tmp_path / "all.db", num_frames=10, known=known)
    last = tuple(sorted(truth.images)[-4:])
    part = without_images(tmp_path / "all.db", tmp_path / "part.db", last)
    view_graph_mapping(part, None, tmp_path / "old", OPTIONS)
    models = view_graph_mapping(tmp_path / "all.db", None, tmp_path / "out", OPTIONS, input_path=tmp_path / "old" / "0")
    assert models[0].num_reg_frames() == 10
    before, after = poses(pycolmap.Reconstruction(tmp_path / "old" / "0")), poses(models[0])
    for name, pose in before.items():
        np.testing.assert_allclose(after[name], pose, atol=1e-9)
    rows = [models[0].image(i).projection_center() for i in sorted(truth.images)]
    distances, similarity = align_positions(
        np.array(rows), np.array([truth.image(i).projection_center() for i in sorted(truth.images)])
    )
    assert distances.max() < 0.01
    if known:
        assert similarity.scale == pytest.approx(1.0, abs=0.01)


def test_from_the_command_line(scene: Path, tmp_path: Path) -> None:
    job = ["mapper", "--database_path", str(scene / "all.db"), "--output_path", str(tmp_path / "out")]
    result = CliRunner().invoke(
        app, [*job, "--input_path", str(scene / "old" / "0"), "--Mapper.fix_existing_images", "1"]
    )
    assert result.exit_code == 0, result.output
    assert "25 of 25 images" in result.output


@pytest.mark.parametrize("kind", ["missing", "empty", "other"])
def test_models_that_cannot_be_extended_are_told_at_once(scene: Path, tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "model"
    told = {
        "missing": "no such folder",
        "empty": "is no COLMAP model",
        "other": "5 of the 25 images of the model",
    }[kind]
    database = scene / "all.db"
    if kind == "empty":
        folder.mkdir()
    if kind == "other":
        folder, database = scene / "joint" / "0", scene / "part.db"
    with pytest.raises(DataFileError, match=told):
        view_graph_mapping(database, None, tmp_path / "out", OPTIONS, input_path=folder)
    assert not (tmp_path / "out").exists()
