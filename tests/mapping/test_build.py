"""The options of building a model that reach pycolmap."""

import pycolmap
import pytest

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
