"""Points added to a model through COLMAP's files, against those that pycolmap adds one by one."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import make_database

from colmap_vg.colmap_io.loading import loaded_reconstruction
from colmap_vg.colmap_io.model_points import keypoints_of_images, with_points
from colmap_vg.errors import OutputError


@pytest.fixture
def posed(tmp_path: Path) -> tuple[pycolmap.Reconstruction, pycolmap.DatabaseCache, pycolmap.Reconstruction]:
    """A model of poses without the last frame, its cache, and the truth."""
    truth = make_database(tmp_path / "a.db", num_images=8, num_points=60, num_cameras_per_rig=2)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions(load_all_images=True))
    model = loaded_reconstruction(cache)
    for rig in truth.rigs.values():
        for sensor in rig.non_ref_sensors:
            model.rig(rig.rig_id).set_sensor_from_rig(sensor, rig.sensor_from_rig(sensor))
    for frame_id in sorted(truth.frames)[:-1]:
        model.frame(frame_id).rig_from_world = truth.frame(frame_id).rig_from_world
        model.register_frame(frame_id)
    return model, cache, truth


def observations(truth: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> list[tuple[int, int, int]]:
    """Row of the point, image and keypoint of the truth's observations in the model's registered images."""
    known = set(model.reg_image_ids())
    return [
        (row, element.image_id, element.point2D_idx)
        for row, point_id in enumerate(sorted(truth.points3D))
        for element in truth.point3D(point_id).track.elements
        if element.image_id in known
    ]


def test_they_are_those_that_pycolmap_adds(posed) -> None:
    model, cache, truth = posed
    found = observations(truth, model)
    positions = np.array([truth.point3D(i).xyz for i in sorted(truth.points3D)])
    added = with_points(model, cache, positions, *np.array(found).T)
    assert model.num_points3D() == 0
    expected = pycolmap.Reconstruction(model)
    for row, position in enumerate(positions):
        track = [pycolmap.TrackElement(image_id, idx) for point, image_id, idx in found if point == row]
        expected.add_point3D(position, pycolmap.Track(track))
    assert sorted(added.points3D) == sorted(expected.points3D) == list(range(1, len(positions) + 1))
    for point_id, point in expected.points3D.items():
        own = added.point3D(point_id)
        np.testing.assert_array_equal(own.xyz, point.xyz)
        assert own.track.elements == point.track.elements
        assert own.error == point.error
    assert sorted(added.images) == sorted(expected.images)
    assert added.reg_frame_ids() == expected.reg_frame_ids()
    for image_id, image in expected.images.items():
        own = added.image(image_id)
        assert (own.name, own.camera_id, own.has_pose) == (image.name, image.camera_id, image.has_pose)
        assert [p.point3D_id for p in own.points2D] == [p.point3D_id for p in image.points2D]
        np.testing.assert_array_equal([p.xy for p in own.points2D], [p.xy for p in image.points2D])
    for camera_id, camera in expected.cameras.items():
        own = added.camera(camera_id)
        assert own.params.tolist() == camera.params.tolist()
        assert (own.model, own.width, own.has_prior_focal_length) == (
            camera.model,
            camera.width,
            camera.has_prior_focal_length,
        )
    assert expected.camera(1).has_prior_focal_length


def test_the_model_keeps_cameras_of_another_camera_model(posed) -> None:
    model, cache, _ = posed
    changed = model.camera(2)
    changed.model, changed.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [1300.0, 512.0, 384.0, 0.01]
    nothing = np.zeros(0, dtype=np.int64)
    added = with_points(model, cache, np.zeros((0, 3)), nothing, nothing, nothing)
    assert added.camera(2).model_name == "SIMPLE_RADIAL"
    assert added.camera(2).params.tolist() == [1300.0, 512.0, 384.0, 0.01]
    assert added.camera(1).model_name == cache.camera(2).model_name == "SIMPLE_PINHOLE"


def test_a_model_without_points_stays_one(posed) -> None:
    model, cache, _ = posed
    nothing = np.zeros(0, dtype=np.int64)
    added = with_points(model, cache, np.zeros((0, 3)), nothing, nothing, nothing)
    assert added.num_points3D() == 0
    assert added.num_reg_images() == model.num_reg_images() == 6
    assert added.num_images() == 8


def test_keypoints_are_those_of_registered_images(posed) -> None:
    model, _, _ = posed
    found = keypoints_of_images(model)
    assert sorted(found) == sorted(model.reg_image_ids())
    for image_id, pixels in found.items():
        np.testing.assert_array_equal(pixels, [p.xy for p in model.image(image_id).points2D])


def test_a_full_temporary_folder_is_said(posed, monkeypatch: pytest.MonkeyPatch) -> None:
    model, cache, _ = posed

    def full(path: Path, content: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    nothing = np.zeros(0, dtype=np.int64)
    with pytest.raises(OutputError, match="TMPDIR"):
        with_points(model, cache, np.zeros((0, 3)), nothing, nothing, nothing)
