"""Points triangulated from a database's matches, against the truth."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import PINHOLE, make_database

from colmap_vg.colmap_io.loading import loaded_reconstruction
from colmap_vg.mapping.points import with_triangulated_points

FISHEYE = ("OPENCV_FISHEYE", (500.0, 500.0, 512.0, 384.0, 0.02, 0.0, 0.0, 0.0))
SPHERE = ("EQUIRECTANGULAR", (1024.0, 768.0))


def posed(path: Path, truth: pycolmap.Reconstruction, num_frames: int):
    with pycolmap.Database.open(path) as database:
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions(load_all_images=True))
    model = loaded_reconstruction(cache)
    for frame_id in sorted(truth.frames)[:num_frames]:
        model.frame(frame_id).rig_from_world = truth.frame(frame_id).rig_from_world
        model.register_frame(frame_id)
    return cache, model


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE])
def test_every_point_is_found_with_its_whole_track(tmp_path: Path, camera) -> None:
    truth = make_database(tmp_path / "a.db", num_images=8, num_points=100, camera=camera)
    cache, model = posed(tmp_path / "a.db", truth, 6)
    found = with_triangulated_points(cache, model)
    assert model.num_points3D() == 0
    expected = {}
    for point in truth.points3D.values():
        seen = sorted((e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in model.reg_image_ids())
        if len(seen) > 2:
            expected[tuple(seen)] = point.xyz
    tracks = {
        tuple(sorted((e.image_id, e.point2D_idx) for e in point.track.elements)): point.xyz
        for point in found.points3D.values()
    }
    assert len(expected) > 50
    assert expected.keys() <= tracks.keys()
    for track, position in expected.items():
        np.testing.assert_allclose(tracks[track], position, atol=1e-6)


def test_keypoints_without_a_ray_make_no_point(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "a.db", num_images=6, num_points=100)
    cache, model = posed(tmp_path / "a.db", truth, 6)
    blind = model.camera(1)
    blind.model = pycolmap.CameraModelId.FOV
    blind.params = [1e-3, 1e-3, 512.0, 384.0, 1.0]
    assert with_triangulated_points(cache, model).num_points3D() == 0
