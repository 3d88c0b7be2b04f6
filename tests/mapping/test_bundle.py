"""One round of bundle adjustment: the scale and the rough that are asked for reach the solver and the short tracks."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.bundle.adjustment import ROUGH_TOLERANCE, TOLERANCE, Adjusted
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.mapping import build, bundle
from colmap_vg.mapping.bundle import Held, adjust_bundle, held_of
from colmap_vg.mapping.options import bundle_options
from colmap_vg.options import MappingOptions

ONE_THREAD = MappingOptions(num_threads=1)
FEW_VIEWS = pycolmap.SyntheticDatasetOptions(
    num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=5, num_points3D=60, num_points2D_without_point3D=0
)
RIG = pycolmap.SyntheticDatasetOptions(
    num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=60, num_points2D_without_point3D=0
)


def with_short_tracks(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with a third of its tracks cut to their first two views."""
    for point_id in sorted(model.points3D)[::3]:
        elements = model.points3D[point_id].track.elements
        for image_id, row in [(element.image_id, element.point2D_idx) for element in elements[2:]]:
            model.delete_observation(image_id, row)
    return model


@pytest.mark.parametrize("rough", [False, True])
def test_the_scale_of_the_residuals_and_the_trial_reach_the_adjustment(
    rough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def adjusted(problem: BundleProblem, state: BundleState, scale_px: float, *, tolerance: float) -> Adjusted:
        asked.append((scale_px, tolerance))
        return Adjusted(state, 4.0, 1.0)

    monkeypatch.setattr(bundle, "loss_scale", lambda *_: 0.37)
    monkeypatch.setattr(bundle, "adjust", adjusted)
    pycolmap.set_random_seed(0)
    assert adjust_bundle(pycolmap.synthesize_dataset(FEW_VIEWS), ONE_THREAD, rough=rough) == 0.25
    assert asked == [(0.37, ROUGH_TOLERANCE if rough else TOLERANCE)]


@pytest.mark.parametrize("rough", [False, True])
def test_they_reach_ceres_where_cameras_are_a_rig(rough: bool, monkeypatch: pytest.MonkeyPatch) -> None:
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
    model = with_short_tracks(pycolmap.synthesize_dataset(RIG))
    adjust_bundle(model, ONE_THREAD, rough=rough, held=held_of(model))
    assert asked == [{"loss_scale_px": 0.37, "rough": rough}]
    assert scales == [0.37]


@pytest.mark.parametrize("rough", [False, True])
def test_one_more_round_is_a_trial_where_that_is_asked_for(rough: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def adjusted(*arguments: object, rough: bool, **options: object) -> float:
        asked.append(rough)
        return adjust_bundle(*arguments, rough=rough, **options)

    monkeypatch.setattr(build, "adjust_bundle", adjusted)
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(":memory:") as database:
        model = pycolmap.synthesize_dataset(FEW_VIEWS, database)
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    assert build.adjust_once_more(cache, model, ONE_THREAD, rough=rough) <= 1.0
    assert asked == [rough]


def test_points_move_unless_held_frames_see_them_mostly() -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=6, num_points3D=120)
    )
    held_images = {1, 2, 3}
    truth = {point_id: point.xyz.copy() for point_id, point in model.points3D.items()}
    few, mostly, rng = [], [], np.random.default_rng(0)
    for point_id in sorted(truth):
        images = [3, 4, 5] if point_id % 2 else [1, 2, 4]
        for element in list(model.point3D(point_id).track.elements):
            if element.image_id not in images:
                model.image(element.image_id).reset_point3D_for_point2D(element.point2D_idx)
                model.point3D(point_id).track.delete_element(element.image_id, element.point2D_idx)
        (few if point_id % 2 else mostly).append(point_id)
        model.point3D(point_id).xyz = truth[point_id] + 0.02 * rng.choice([-1.0, 1.0], 3)
    frames = frozenset(model.image(image_id).frame_id for image_id in held_images)
    options = MappingOptions(ba_refine_focal_length=False, ba_refine_extra_params=False, num_threads=1)
    adjust_bundle(model, options, held=Held(frames=frames))
    off = {point_id: np.linalg.norm(model.point3D(point_id).xyz - truth[point_id]) for point_id in truth}
    assert np.median([off[k] for k in few]) < 0.3 * 0.02 * np.sqrt(3)
    assert np.min([off[k] for k in mostly]) > 0.9 * 0.02 * np.sqrt(3)


@pytest.mark.parametrize("held", [(), (1,), (1, 2)])
@pytest.mark.parametrize("with_rig", [False, True])
def test_points_that_the_adjustment_leaves_follow_the_cameras(
    held: tuple[int, ...], with_rig: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    refined = []

    def recorded(positions: np.ndarray, *_: object, scale_px: float) -> np.ndarray:
        refined.append(len(positions))
        return positions

    monkeypatch.setattr(bundle, "refine_points", recorded)
    pycolmap.set_random_seed(0)
    model = with_short_tracks(pycolmap.synthesize_dataset(RIG if with_rig else FEW_VIEWS))
    expected = 0
    for point in model.points3D.values():
        frames = [model.image(element.image_id).frame_id for element in point.track.elements]
        short = len(frames) < 3 or (with_rig and len(held) > 0)  # Ceres moves no point that held frames see
        expected += short and 2 * sum(frame in held for frame in frames) <= len(frames)
    adjust_bundle(model, ONE_THREAD, held=held_of(model, frozenset(held)))
    assert refined == ([expected] if expected else [])
    assert (expected == 0) == (held == (1, 2))
