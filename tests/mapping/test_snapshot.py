"""Snapshots of reconstructions whose lenses run away."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.mapping.snapshot import Snapshot


def scene(model: str, params: list[float]) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=5,
        num_points3D=40,
        camera_model_id=getattr(pycolmap.CameraModelId, model),
        camera_params=params,
    )
    return pycolmap.synthesize_dataset(options)


def test_a_lens_that_projects_nothing_is_noticed_and_restored() -> None:
    model = scene("EUCM", [640.0, 640.0, 512.0, 384.0, 0.6, 1.1])
    before = Snapshot.of(model)
    assert before is not None
    assert before.num_projected > 100
    assert not before.is_spoilt(model)
    camera, point = model.camera(1), model.point3D(1)
    kept, place = camera.params.tolist(), np.array(point.xyz)
    camera.params = [-856.0, -678.0, 512.0, 384.0, -1038.0, 2285.0]
    point.xyz = place + 5.0
    assert before.is_spoilt(model)
    before.restore(model)
    assert not before.is_spoilt(model)
    assert model.camera(1).params.tolist() == pytest.approx(kept)
    np.testing.assert_allclose(model.point3D(1).xyz, place)


def test_no_snapshot_is_taken_of_simple_lenses() -> None:
    assert Snapshot.of(scene("SIMPLE_RADIAL", [1280.0, 512.0, 384.0, 0.05])) is None
