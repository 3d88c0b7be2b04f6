"""pycolmap's option objects for each mapping step, made from `MappingOptions`."""

import pycolmap

from colmap_vg.options import MappingOptions

MAX_REPROJECTION_PX = 4.0
MIN_TRIANGULATION_ANGLE_DEG = 1.5
"""COLMAP's default thresholds for triangulated points: reprojection error in pixels, angle in degrees."""
MAX_EXTRA_PARAM = 1e6
"""Maximum distortion parameter; COLMAP's default of 1 rejects cameras whose model may exceed it (EUCM's beta)."""
MIN_TRACK_LENGTH = 3
"""Minimum number of views of points that adjust the cameras."""
TOLERANCE, MAX_NUM_STEPS = 1e-5, 40
"""Relative change of the cost by a step at which bundle adjustment ends, and its maximum number of steps."""
ROUGH_TOLERANCE = 1e-3
"""The same where only the cost is asked for, or another round follows."""
MIN_RESIDUALS_FOR_THREADS = 150_000
"""Residuals, two for each observation, below which one thread is as soon done and takes less of the processors."""


def triangulator_options(options: MappingOptions) -> "pycolmap.IncrementalTriangulatorOptions":
    """Triangulation options: COLMAP's thresholds, with the given random seed."""
    return pycolmap.IncrementalTriangulatorOptions(
        min_angle=MIN_TRIANGULATION_ANGLE_DEG,
        complete_max_reproj_error=MAX_REPROJECTION_PX,
        merge_max_reproj_error=MAX_REPROJECTION_PX,
        max_extra_param=MAX_EXTRA_PARAM,
        random_seed=options.random_seed,
    )


def mapper_options(options: MappingOptions) -> "pycolmap.IncrementalMapperOptions":
    """Registration and filtering options: COLMAP's thresholds, with the given choice of intrinsics to refine."""
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
    options: MappingOptions, *, loss_scale_px: float, rough: bool = False
) -> "pycolmap.BundleAdjustmentOptions":
    """Bundle adjustment options, with a Cauchy loss, which gave better results than Huber's.

    Each step is followed by steps of every point alone, until these gain little: three steps in all reach what
    forty others do not where the points determine the cameras loosely. The initial trust region is wide since the poses
    are nearly right. A narrow one damps what is determined least, such as the bend of a long street. A rough adjustment
    does without steps of the points and ends early.
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
    bundle.ceres.min_num_residuals_for_cpu_multi_threading = MIN_RESIDUALS_FOR_THREADS
    solver = bundle.ceres.solver_options
    solver.use_inner_iterations = not rough
    solver.function_tolerance, solver.max_num_iterations = ROUGH_TOLERANCE if rough else TOLERANCE, MAX_NUM_STEPS
    solver.initial_trust_region_radius = 1e12
    solver.num_threads = options.num_threads
    return bundle
