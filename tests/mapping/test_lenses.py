"""Warnings of lenses that bundle adjustment made hardly real."""

from pathlib import Path

import pycolmap
import pytest
from synthetic_databases import make_database

from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database
from colmap_vg.mapping import lenses
from colmap_vg.mapping.lenses import MAX_STRETCH, warn_of_stretched
from colmap_vg.options import MappingOptions


class Cameras:
    """Cameras alone, as of a database cache."""

    def __init__(self, reconstruction: pycolmap.Reconstruction) -> None:
        self._cameras = {i: pycolmap.Camera(camera.todict()) for i, camera in reconstruction.cameras.items()}

    def camera(self, camera_id: int) -> pycolmap.Camera:
        return self._cameras[camera_id]


def model(name: str, params: list[float]) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=3,
            num_cameras_per_rig=1,
            num_frames_per_rig=2,
            num_points3D=20,
            camera_model_id=getattr(pycolmap.CameraModelId, name),
            camera_params=params,
        )
    )


def warnings(reconstruction: pycolmap.Reconstruction, before: Cameras) -> list[str]:
    log = StageLog()
    with log.stage("adjust"):
        warn_of_stretched(reconstruction, before, log)
    return list(log.warnings)


@pytest.mark.parametrize("factor", [1.02 * MAX_STRETCH, 0.98 / MAX_STRETCH])
def test_focal_lengths_that_move_apart_are_named(factor: float) -> None:
    reconstruction = model("OPENCV", [1000.0, 800.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0])
    before = Cameras(reconstruction)
    assert warnings(reconstruction, before) == []
    lens = reconstruction.camera(2)
    lens.params = [factor * lens.params[0], *lens.params[1:]]
    (told,) = warnings(reconstruction, before)
    assert "1 cameras (first: 2, from 1.25 to" in told
    for image_id in sorted(reconstruction.reg_image_ids()):
        if reconstruction.image(image_id).camera_id == 2:
            reconstruction.deregister_frame(reconstruction.image(image_id).frame_id)
    assert warnings(reconstruction, before) == []


@pytest.mark.parametrize("factor", [0.99 * MAX_STRETCH, 1.01 / MAX_STRETCH])
def test_small_changes_and_common_ones_are_not(factor: float) -> None:
    reconstruction = model("PINHOLE", [1000.0, 1000.0, 500.0, 400.0])
    before = Cameras(reconstruction)
    reconstruction.camera(1).params = [factor * 1000.0, 1000.0, 500.0, 400.0]
    reconstruction.camera(2).params = [3000.0, 3000.0, 500.0, 400.0]
    assert warnings(reconstruction, before) == []


def test_lenses_with_one_focal_length_have_no_ratio() -> None:
    reconstruction = model("SIMPLE_RADIAL", [1000.0, 500.0, 400.0, 0.0])
    before = Cameras(reconstruction)
    reconstruction.camera(1).params = [3000.0, 500.0, 400.0, 0.0]
    assert warnings(reconstruction, before) == []


def test_jobs_ask_whether_they_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = ("PINHOLE", (1280.0, 1280.0, 512.0, 384.0))
    make_database(tmp_path / "a.db", num_images=6, num_points=100, noise_px=0.5, camera=camera)
    monkeypatch.setattr(lenses, "MAX_STRETCH", 1.0)
    log = StageLog()
    map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), log)
    assert any("focal lengths in x and y of 1 cameras" in told for told in log.warnings)
