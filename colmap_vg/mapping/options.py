"""pycolmap's option objects for each step, from ours."""

import pycolmap

from colmap_vg.options import MappingOptions

MAX_REPROJECTION_PX = 4.0
MIN_TRIANGULATION_ANGLE_DEG = 1.5
"""COLMAP's own thresholds for points."""
MAX_EXTRA_PARAM = 1e6
"""COLMAP leaves out cameras with a distortion parameter above 1, which some models rightly have (EUCM's beta)."""
MIN_TRACK_LENGTH = 3
"""Of points that adjust cameras."""


def triangulator_options(options: MappingOptions) -> "pycolmap.IncrementalTriangulatorOptions":
    """Thresholds of COLMAP, with the job's seed."""
    return pycolmap.IncrementalTriangulatorOptions(
        min_angle=MIN_TRIANGULATION_ANGLE_DEG,
        complete_max_reproj_error=MAX_REPROJECTION_PX,
        merge_max_reproj_error=MAX_REPROJECTION_PX,
        max_extra_param=MAX_EXTRA_PARAM,
        random_seed=options.random_seed,
    )


def mapper_options(options: MappingOptions) -> "pycolmap.IncrementalMapperOptions":
    """Registration and filtering as in COLMAP, with our switches for intrinsics."""
    return pycolmap.IncrementalMapperOptions(
        abs_pose_refine_focal_length=options.ba_refine_focal_length,
        abs_pose_refine_extra_params=options.ba_refine_extra_params,
        filter_max_reproj_error=MAX_REPROJECTION_PX,
        filter_min_tri_angle=MIN_TRIANGULATION_ANGLE_DEG,
        max_extra_param=MAX_EXTRA_PARAM,
        num_threads=options.num_threads,
        random_seed=options.random_seed,
    )


def bundle_options(
    options: MappingOptions, *, loss_scale_px: float, max_num_iterations: int, function_tolerance: float
) -> "pycolmap.BundleAdjustmentOptions":
    """Bundle adjustment with a Cauchy loss: Huber ends worse.

    The trust region is wide from the start. Poses come nearly right, and what a narrow one holds back is what the
    points fix least: the bend of a long street took three times the steps.
    """
    bundle = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=options.ba_refine_focal_length,
        refine_principal_point=options.ba_refine_principal_point,
        refine_extra_params=options.ba_refine_extra_params,
        min_track_length=MIN_TRACK_LENGTH,
        print_summary=False,
    )
    bundle.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    bundle.ceres.loss_function_scale = loss_scale_px
    bundle.ceres.solver_options.max_num_iterations = max_num_iterations
    bundle.ceres.solver_options.function_tolerance = function_tolerance
    bundle.ceres.solver_options.initial_trust_region_radius = 1e8
    bundle.ceres.solver_options.num_threads = options.num_threads
    return bundle
