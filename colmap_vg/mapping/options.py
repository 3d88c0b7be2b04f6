"""pycolmap's option objects for each step, from ours."""

import pycolmap

from colmap_vg.options import MappingOptions

MAX_REPROJECTION_PX = 4.0
MIN_TRIANGULATION_ANGLE_DEG = 1.5
"""COLMAP's own thresholds for points."""


def triangulator_options(options: MappingOptions) -> "pycolmap.IncrementalTriangulatorOptions":
    """Thresholds of COLMAP, with the job's seed."""
    return pycolmap.IncrementalTriangulatorOptions(
        min_angle=MIN_TRIANGULATION_ANGLE_DEG,
        complete_max_reproj_error=MAX_REPROJECTION_PX,
        merge_max_reproj_error=MAX_REPROJECTION_PX,
        random_seed=options.random_seed,
    )


def mapper_options(options: MappingOptions) -> "pycolmap.IncrementalMapperOptions":
    """Registration and filtering as in COLMAP, with our switches for intrinsics."""
    return pycolmap.IncrementalMapperOptions(
        abs_pose_refine_focal_length=options.ba_refine_focal_length,
        abs_pose_refine_extra_params=options.ba_refine_extra_params,
        filter_max_reproj_error=MAX_REPROJECTION_PX,
        filter_min_tri_angle=MIN_TRIANGULATION_ANGLE_DEG,
        num_threads=options.num_threads,
        random_seed=options.random_seed,
    )


def bundle_options(
    options: MappingOptions, *, max_num_iterations: int, function_tolerance: float, min_track_length: int
) -> "pycolmap.BundleAdjustmentOptions":
    """Bundle adjustment with a Cauchy loss of one pixel: Huber ends worse, two-view tracks pull it away."""
    bundle = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=options.ba_refine_focal_length,
        refine_principal_point=options.ba_refine_principal_point,
        refine_extra_params=options.ba_refine_extra_params,
        min_track_length=min_track_length,
        print_summary=False,
    )
    bundle.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    bundle.ceres.loss_function_scale = 1.0
    bundle.ceres.solver_options.max_num_iterations = max_num_iterations
    bundle.ceres.solver_options.function_tolerance = function_tolerance
    bundle.ceres.solver_options.num_threads = options.num_threads
    return bundle
