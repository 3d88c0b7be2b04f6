"""Photographs without EXIF: one lens where nothing speaks against it, the database's own cameras in the model."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from synthetic_databases import centers, changed_copy, make_database, pair_id, sha256

from colmap_vg import MappingOptions, align_positions, read_view_graph, view_graph_mapping
from colmap_vg.colmap_io.shared_cameras import merge_cameras, shared_cameras

RADIAL = ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05))


def without_focals(path: Path, guess: float = 1228.8) -> Path:
    """A copy whose cameras know as much as COLMAP makes of a photograph without EXIF."""
    params = np.array([guess, 512.0, 384.0, 0.0])
    return changed_copy(
        path,
        path.with_name("guessed.db"),
        ("UPDATE cameras SET prior_focal_length = 0, params = ?", (params.tobytes(),)),
        # Their pairs were verified without a focal length, too.
        "UPDATE two_view_geometries SET config = 3, E = NULL, qvec = NULL, tvec = NULL",
    )


def test_cameras_share_a_lens_and_the_model_has_them_all(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "true.db", noise_px=0.5, camera=RADIAL, camera_per_image=True, num_points=400)
    path = without_focals(tmp_path / "true.db")
    before = sha256(path)
    models = {
        share: view_graph_mapping(path, None, tmp_path / str(share), MappingOptions(share_cameras=share))[0]
        for share in (True, False)
    }
    assert sha256(path) == before
    errors = {}
    for share, model in models.items():
        assert model.num_reg_images() == 10
        assert sorted(model.cameras) == sorted(truth.cameras)
        ids = sorted(model.reg_image_ids())
        assert [model.image(i).camera_id for i in ids] == [truth.image(i).camera_id for i in ids]
        errors[share] = align_positions(centers(model, ids), centers(truth, ids))[0].mean()
        params = np.array([camera.params for camera in model.cameras.values()])
        assert (np.ptp(params, axis=0).max() == 0.0) == share
        np.testing.assert_allclose(params[:, 0], 1280.0, rtol=0.01 if share else 0.03)
    assert errors[True] < errors[False]
    written = pycolmap.Reconstruction(tmp_path / "True" / "0")
    assert written.num_points3D() == models[True].num_points3D()
    written.update_point_3d_errors()
    assert written.compute_mean_reprojection_error() < 1.0


def test_each_of_two_models_has_its_own_cameras_only(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "true.db", noise_px=0.5, camera=RADIAL, camera_per_image=True, num_points=400)
    ids = sorted(truth.images)
    halves = set(ids[:5]), set(ids[5:])
    apart = [("DELETE FROM two_view_geometries WHERE pair_id = ?", (pair_id(i, j),)) for i in ids[:5] for j in ids[5:]]
    path = changed_copy(tmp_path / "true.db", tmp_path / "apart.db", *apart)
    models = view_graph_mapping(path, None, tmp_path / "out")
    assert len(models) == 2
    for index, model in models.items():
        written = pycolmap.Reconstruction(tmp_path / "out" / str(index))
        assert set(model.reg_image_ids()) in halves
        for kept in (model, written):
            assert set(kept.images) == set(model.reg_image_ids())
            assert set(kept.cameras) == {truth.image(i).camera_id for i in model.reg_image_ids()}
            assert len(kept.rigs) == len(kept.frames) == 5


def test_lenses_that_differ_are_found_out(tmp_path: Path) -> None:
    # Two lenses, 10 % apart, on images of one size. Cameras that look at one point from one distance cannot tell their
    # focal lengths pair by pair, so all start with one; bundle adjustment shows the difference.
    truth = make_database(tmp_path / "true.db", noise_px=0.5, camera=RADIAL, camera_per_image=True, num_points=300)
    with closing(sqlite3.connect(tmp_path / "true.db")) as connection, connection:
        for image_id in sorted(truth.images)[::2]:
            query = "SELECT data, rows, cols FROM keypoints WHERE image_id = ?"
            data, *shape = connection.execute(query, (image_id,)).fetchone()
            keypoints = np.frombuffer(data, dtype=np.float32).reshape(shape).copy()
            keypoints[:, :2] = 1.1 * (keypoints[:, :2] - [512, 384]) + [512, 384]
            connection.execute("UPDATE keypoints SET data = ? WHERE image_id = ?", (keypoints.tobytes(), image_id))
    model = view_graph_mapping(without_focals(tmp_path / "true.db"), None, tmp_path / "out")[0]
    focals = np.array([model.camera(model.image(i).camera_id).mean_focal_length() for i in sorted(model.images)])
    np.testing.assert_allclose(focals[::2], 1408.0, rtol=0.03)
    np.testing.assert_allclose(focals[1::2], 1280.0, rtol=0.03)


def test_equal_given_calibrations_are_refined_as_one(tmp_path: Path) -> None:
    path = tmp_path / "true.db"
    truth = make_database(path, noise_px=0.5, camera=RADIAL, camera_per_image=True, num_points=400)
    (ids,) = shared_cameras(read_view_graph(path))
    assert ids == sorted(truth.cameras)
    errors = {}
    for share in (True, False):
        model = view_graph_mapping(path, None, tmp_path / str(share), MappingOptions(share_cameras=share))[0]
        params = np.array([camera.params for camera in model.cameras.values()])
        assert (np.ptp(params, axis=0).max() == 0.0) == share
        image_ids = sorted(model.reg_image_ids())
        errors[share] = align_positions(centers(model, image_ids), centers(truth, image_ids))[0].mean()
    assert errors[True] < errors[False]


def test_given_calibrations_that_differ_are_not_shared(tmp_path: Path) -> None:
    make_database(tmp_path / "true.db", camera=RADIAL, camera_per_image=True, num_images=4)
    with closing(sqlite3.connect(tmp_path / "true.db")) as connection, connection:
        for camera_id in range(1, 5):
            params = np.array([1280.0 + camera_id, 512.0, 384.0, 0.05]).tobytes()
            connection.execute("UPDATE cameras SET params = ? WHERE camera_id = ?", (params, camera_id))
    assert shared_cameras(read_view_graph(tmp_path / "true.db")) == []


def test_only_alike_cameras_are_merged(tmp_path: Path) -> None:
    make_database(tmp_path / "true.db", camera=RADIAL, camera_per_image=True, num_images=4)
    ids = sorted(pycolmap.Database.open(tmp_path / "true.db").read_all_cameras(), key=lambda c: c.camera_id)
    ids = [camera.camera_id for camera in ids]
    with closing(sqlite3.connect(tmp_path / "true.db")) as connection, connection:
        connection.execute("UPDATE cameras SET width = 1023 WHERE camera_id = ?", (ids[2],))
    assert merge_cameras(tmp_path / "true.db", [ids]) == {ids[1]: ids[0], ids[3]: ids[0]}
    with pycolmap.Database.open(tmp_path / "true.db") as database:
        assert sorted(camera.camera_id for camera in database.read_all_cameras()) == [ids[0], ids[2]]
        assert len(database.read_all_frames()) == 4


def test_databases_from_before_rigs_share_cameras_too(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "true.db", noise_px=0.5, camera=RADIAL, camera_per_image=True, num_points=400)
    tables = [f"DELETE FROM {table}" for table in ("rigs", "rig_sensors", "frames", "frame_data")]
    path = changed_copy(without_focals(tmp_path / "true.db"), tmp_path / "old.db", *tables)
    model = view_graph_mapping(path, None, tmp_path / "out")[0]
    assert sorted(model.cameras) == sorted(truth.cameras)
    np.testing.assert_allclose([camera.mean_focal_length() for camera in model.cameras.values()], 1280.0, rtol=0.01)
