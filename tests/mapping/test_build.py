"""The options of building a model that reach pycolmap, and when its rounds of adjustment end."""

from pathlib import Path
from unittest.mock import Mock

import pycolmap
import pytest

from colmap_vg.mapping import build
from colmap_vg.mapping.build import MAX_NUM_ROUNDS
from colmap_vg.mapping.bundle import NOTHING_HELD
from colmap_vg.mapping.options import (
    MAX_NUM_STEPS,
    MIN_RESIDUALS_FOR_THREADS,
    ROUGH_TOLERANCE,
    TOLERANCE,
    bundle_options,
    mapper_options,
    triangulator_options,
)
from colmap_vg.options import MappingOptions


@pytest.mark.parametrize("switch", [True, False])
def test_switches_threads_and_seed_reach_pycolmap(switch: bool) -> None:
    options = MappingOptions(
        ba_refine_focal_length=switch,
        ba_refine_principal_point=not switch,
        ba_refine_extra_params=switch,
        num_threads=3,
        random_seed=7,
    )
    bundle = bundle_options(options, loss_scale_px=0.7)
    assert (bundle.refine_focal_length, bundle.refine_principal_point) == (switch, not switch)
    assert bundle.refine_extra_params == switch
    assert bundle.min_track_length == 3
    assert not bundle.print_summary
    assert bundle.ceres.loss_function_type == pycolmap.LossFunctionType.CAUCHY
    assert bundle.ceres.loss_function_scale == 0.7
    solver = bundle.ceres.solver_options
    assert (solver.max_num_iterations, solver.function_tolerance) == (MAX_NUM_STEPS, TOLERANCE)
    assert (solver.use_inner_iterations, solver.num_threads) == (True, 3)
    assert bundle.ceres.min_num_residuals_for_cpu_multi_threading == MIN_RESIDUALS_FOR_THREADS
    solver = bundle_options(options, loss_scale_px=0.7, rough=True).ceres.solver_options
    assert (solver.use_inner_iterations, solver.function_tolerance) == (False, ROUGH_TOLERANCE)
    mapper = mapper_options(options)
    assert (mapper.abs_pose_refine_focal_length, mapper.abs_pose_refine_extra_params) == (switch, switch)
    assert (mapper.num_threads, mapper.random_seed) == (3, 7)
    assert triangulator_options(options).random_seed == 7


def test_tracks_that_a_new_image_lengthens_are_completed(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=40)
    with pycolmap.Database.open(tmp_path / "all.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    pose = model.frame(3).rig_from_world
    model.deregister_frame(3)
    for place in range(model.image(5).num_points2D()):
        if model.image(5).point2D(place).has_point3D():
            model.delete_observation(5, place)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    assert build._register_placed(mapper, MappingOptions(), {3: pose}) == {3}
    assert (model.image(3).num_points3D, model.image(5).num_points3D) == (40, 0)
    build._complete_new_tracks(mapper, MappingOptions())
    assert model.image(5).num_points3D == 40
    mapper.end_reconstruction(False)


def test_images_without_enough_observations_are_removed() -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=6, num_points3D=100))
    manager = pycolmap.ObservationManager(model)
    seen = [place for place in range(model.image(3).num_points2D()) if model.image(3).point2D(place).has_point3D()]
    for place in seen[build.MIN_SUPPORTED_OBSERVATIONS - 1 :]:
        manager.delete_observation(3, place)
    mapper = Mock(reconstruction=model, observation_manager=manager)
    assert build._remove_unsupported(mapper, frozenset({model.image(3).frame_id})) == set()
    assert build._remove_unsupported(mapper) == {3}
    assert not model.image(3).has_pose
    assert model.num_reg_images() == 11


@pytest.mark.parametrize(
    ("ratios", "growth", "rounds"),
    [
        ([0.9], [1.005], 1),
        ([0.9, 0.9], [1.05, 1.005], 2),  # a focal length still moves
        ([0.5, 0.9], [1.0, 1.0], 2),  # so does the cost
        ([0.5] * MAX_NUM_ROUNDS, [1.0] * MAX_NUM_ROUNDS, MAX_NUM_ROUNDS),
    ],
)
def test_rounds_end_where_cost_and_focal_lengths_do(
    ratios: list[float], growth: list[float], rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_frames_per_rig=3,
            num_points3D=20,
            camera_model_id=pycolmap.CameraModelId.OPENCV,
            camera_params=[900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0],
        )
    )
    asked: list[bool] = []

    def adjusted(*_: object, rough: bool = False) -> float:
        asked.append(rough)
        factor = 1.5 if rough else growth[len(asked) - 2]
        for camera in model.cameras.values():
            camera.params = [factor * camera.params[0], factor * camera.params[1], *camera.params[2:]]
        return 0.1 if rough else ratios[len(asked) - 2]

    mapper = Mock(reconstruction=model)
    monkeypatch.setattr(build, "_adjust", adjusted)
    assert build._adjust_to_convergence(mapper, MappingOptions(), NOTHING_HELD) == (ratios[rounds - 1] > 0.7)
    assert asked == [True] + rounds * [False]
    assert mapper.retriangulate.call_count == rounds
