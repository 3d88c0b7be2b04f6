"""One round of bundle adjustment: the scale and the trial that are asked for reach the solver and the short tracks."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.mapping import build, bundle
from colmap_vg.mapping.bundle import adjust_bundle
from colmap_vg.mapping.options import bundle_options
from colmap_vg.options import MappingOptions

ONE_THREAD = MappingOptions(num_threads=1)
FEW_VIEWS = pycolmap.SyntheticDatasetOptions(
    num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=5, num_points3D=60, num_points2D_without_point3D=0
)


def with_short_tracks(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with a third of its tracks cut to their first two views."""
    for point_id in sorted(model.points3D)[::3]:
        elements = model.points3D[point_id].track.elements
        for image_id, row in [(element.image_id, element.point2D_idx) for element in elements[2:]]:
            model.delete_observation(image_id, row)
    return model


@pytest.mark.parametrize("trial", [False, True])
def test_the_scale_of_the_residuals_and_the_trial_reach_the_adjustment(
    trial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, scales = [], []

    def made(*arguments: object, **named: object) -> pycolmap.BundleAdjustmentOptions:
        asked.append(named)
        return bundle_options(*arguments, **named)

    def refined(positions: np.ndarray, *_: object, scale_px: float) -> np.ndarray:
        scales.append(scale_px)
        return positions

    monkeypatch.setattr(bundle, "loss_scale", lambda *_: 0.37)
    monkeypatch.setattr(bundle, "bundle_options", made)
    monkeypatch.setattr(bundle, "refine_points", refined)
    pycolmap.set_random_seed(0)
    adjust_bundle(with_short_tracks(pycolmap.synthesize_dataset(FEW_VIEWS)), ONE_THREAD, trial=trial)
    assert asked == [{"loss_scale_px": 0.37, "trial": trial}]
    assert scales == [0.37]


@pytest.mark.parametrize("trial", [False, True])
def test_one_more_round_is_a_trial_where_that_is_asked_for(trial: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def adjusted(*arguments: object, trial: bool, **options: object) -> float:
        asked.append(trial)
        return adjust_bundle(*arguments, trial=trial, **options)

    monkeypatch.setattr(build, "adjust_bundle", adjusted)
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(":memory:") as database:
        model = pycolmap.synthesize_dataset(FEW_VIEWS, database)
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    assert build.adjust_once_more(cache, model, ONE_THREAD, trial=trial) <= 1.0
    assert asked == [trial]
