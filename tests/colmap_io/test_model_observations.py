"""Observations of a model as arrays: those that pycolmap tells one by one."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.errors import OutputError


def test_they_are_those_of_the_registered_images() -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=50, num_points2D_without_point3D=20
        )
    )
    model.image(2).name = "a name with blanks/and a folder.jpg"
    for point_id in sorted(model.points3D)[::3]:
        model.delete_point3D(point_id)
    model.deregister_frame(model.image(3).frame_id)
    expected = [
        (image_id, keypoint.point3D_id, *keypoint.xy.tolist())
        for image_id in sorted(model.reg_image_ids())
        for keypoint in model.image(image_id).get_observation_points2D()
    ]
    found = ModelObservations.of(model)
    assert len(expected) > 100
    told = zip(found.image_ids.tolist(), found.point_ids.tolist(), *found.keypoints.T.tolist(), strict=True)
    assert list(told) == expected
    assert found.every_point.tolist() == sorted(model.points3D)
    np.testing.assert_array_equal(found.positions, [model.point3D(i).xyz for i in sorted(model.points3D)])
    some = found.every_point[[7, 2, 2]]
    np.testing.assert_array_equal(found.positions_of(some), [model.point3D(i).xyz for i in some.tolist()])


def test_points_that_no_image_sees_have_positions_too() -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=3, num_points3D=20))
    model.delete_point3D(5)
    model.add_point3D_with_id(5, pycolmap.Point3D(xyz=[1.0, 2.0, 3.0]))
    found = ModelObservations.of(model)
    assert found.every_point.tolist() == list(range(1, 21))
    np.testing.assert_array_equal(found.positions, [model.point3D(i).xyz for i in range(1, 21)])
    assert not np.isin(5, found.point_ids)


def test_observations_of_the_points_in_an_image() -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(num_frames_per_rig=6, num_points3D=40, track_length=3)
    )
    every = ModelObservations.of(model)
    found = every.of_points_in([2])
    points = {keypoint.point3D_id for keypoint in model.image(2).get_observation_points2D()}
    assert 0 < len(points) < 40
    expected = [k for k, point_id in enumerate(every.point_ids.tolist()) if point_id in points]
    np.testing.assert_array_equal(found.point_ids, every.point_ids[expected])
    np.testing.assert_array_equal(found.image_ids, every.image_ids[expected])
    np.testing.assert_array_equal(found.keypoints, every.keypoints[expected])
    assert len(every.of_points_in([]).keypoints) == 0


def test_a_model_without_images_has_none() -> None:
    found = ModelObservations.of(pycolmap.Reconstruction())
    assert found.keypoints.shape == (0, 2)
    assert len(found.image_ids) == len(found.point_ids) == len(found.every_point) == 0
    assert found.positions.shape == (0, 3)
    assert found.image_ids.dtype == np.int64


@pytest.mark.parametrize(
    ("name", "size"),
    [("images", size) for size in (0, 40, 5000, -1, None)] + [("points3D", size) for size in (0, 30, 2000, -1)],
)
def test_a_temporary_folder_without_room_is_told(name: str, size: int | None) -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=3, num_points3D=50))

    class CutOff:
        """Writes a part of one file, which ends within the last image's name if no size is given."""

        def write_binary(self, folder: str) -> None:
            model.write_binary(folder)
            path = Path(folder) / f"{name}.bin"
            content, last = path.read_bytes(), model.image(max(model.images)).name
            path.write_bytes(content[: content.index(last.encode()) + 3 if size is None else size])

    with pytest.raises(OutputError, match="does not fit into the temporary folder"):
        ModelObservations.of(CutOff())
