"""The flags of COLMAP's mappers and of ``glomap mapper``: obeyed, known, or unknown.

Scripts written for those mappers keep working: what has a counterpart here is obeyed, what has none is named in a
warning, and what none of them knows is an error. Names are those of COLMAP 3.8 to 4.2 and GLOMAP 1.0 to 1.2.
"""

from collections.abc import Sequence
from difflib import get_close_matches

REFINE_FOCAL_LENGTH = (
    "--ba_refine_focal_length",
    "--Mapper.ba_refine_focal_length",
    "--GlobalMapper.ba_refine_focal_length",
)
REFINE_PRINCIPAL_POINT = (
    "--ba_refine_principal_point",
    "--Mapper.ba_refine_principal_point",
    "--GlobalMapper.ba_refine_principal_point",
    "--BundleAdjustment.optimize_principal_point",
)
REFINE_EXTRA_PARAMS = (
    "--ba_refine_extra_params",
    "--Mapper.ba_refine_extra_params",
    "--GlobalMapper.ba_refine_extra_params",
)
REFINE_INTRINSICS = ("--BundleAdjustment.optimize_intrinsics",)
USE_PRIOR_POSITION = ("--use_prior_position", "--Mapper.use_prior_position", "--PosePrior.use_pose_position_prior")
OVERWRITE_PRIORS_COVARIANCE = ("--overwrite_priors_covariance", "--PosePrior.overwrite_priors_covariance")
PRIOR_POSITION_STD_X = ("--prior_position_std_x", "--PosePrior.prior_position_std_x")
PRIOR_POSITION_STD_Y = ("--prior_position_std_y", "--PosePrior.prior_position_std_y")
PRIOR_POSITION_STD_Z = ("--prior_position_std_z", "--PosePrior.prior_position_std_z")
FIX_EXISTING_FRAMES = ("--fix_existing_frames", "--Mapper.fix_existing_frames", "--Mapper.fix_existing_images")
USE_PRIOR_GRAVITY = ("--use_prior_gravity", "--GlobalMapper.ra_use_gravity")
EXTRACT_COLORS = ("--extract_colors", "--Mapper.extract_colors")
NUM_THREADS = ("--num_threads", "--Mapper.num_threads", "--GlobalMapper.num_threads")
RANDOM_SEED = ("--random_seed", "--seed", "--Mapper.random_seed", "--GlobalMapper.random_seed")
MIN_NUM_MATCHES = (
    "--min_num_matches",
    "--Mapper.min_num_matches",
    "--GlobalMapper.min_num_matches",
    "--Thresholds.min_inlier_num",
)
ROTATION_GATE = ("--rotation_gate_deg", "--GlobalMapper.ra_max_rotation_error_deg", "--Thresholds.max_rotation_error")

_IGNORED = {
    "": """
        project_path log_to_stderr log_level log_target log_severity log_color default_random_seed
        image_list_path constraint_type ba_iteration_num retriangulation_iteration_num output_format
        skip_preprocessing skip_view_graph_calibration skip_relative_pose_estimation skip_rotation_averaging
        skip_track_establishment skip_global_positioning skip_bundle_adjustment skip_retriangulation skip_pruning
        use_robust_loss_on_prior_position prior_position_loss_scale
        num_workers image_overlap leaf_max_num_images
        """,
    "Mapper.": """
        ignore_watermarks multiple_models max_num_models max_model_overlap min_model_size init_image_id1 init_image_id2
        init_num_trials structure_less_registration_fallback structure_less_registration_only min_focal_length_ratio
        max_focal_length_ratio max_extra_param ba_refine_sensor_from_rig ba_local_num_images ba_local_min_tri_angle
        ba_local_function_tolerance ba_local_max_num_iterations ba_local_max_refinements ba_local_max_refinement_change
        ba_local_backend ba_global_images_ratio ba_global_frames_ratio ba_global_points_ratio ba_global_images_freq
        ba_global_frames_freq ba_global_points_freq ba_global_function_tolerance ba_global_max_num_iterations
        ba_global_max_refinements ba_global_max_refinement_change ba_global_backend
        ba_global_ignore_redundant_points3D ba_global_ignore_redundant_points3D_min_coverage_gain
        ba_global_prune_points_min_coverage_gain ba_use_gpu ba_gpu_index
        ba_min_num_residuals_for_cpu_multi_threading snapshot_path snapshot_images_freq snapshot_frames_freq
        init_min_num_inliers init_max_error init_max_forward_motion
        init_min_tri_angle init_max_reg_trials abs_pose_max_error abs_pose_min_num_inliers abs_pose_min_inlier_ratio
        abs_pose_refine_focal_length abs_pose_refine_extra_params filter_max_reproj_error filter_min_tri_angle
        max_reg_trials local_ba_min_tri_angle image_selection_method image_list_path constant_rig_list_path
        constant_camera_list_path max_runtime_seconds use_robust_loss_on_prior_position
        prior_position_loss_scale load_all_images tri_max_transitivity tri_create_max_angle_error
        tri_continue_max_angle_error tri_merge_max_reproj_error tri_complete_max_reproj_error
        tri_complete_max_transitivity tri_re_max_angle_error tri_re_min_ratio tri_re_max_trials tri_min_angle
        tri_ignore_two_view_tracks
        """,
    "GlobalMapper.": """
        image_list_path ignore_watermarks decompose_relative_pose multiple_models min_model_size ba_num_iterations
        skip_rotation_averaging skip_track_establishment skip_global_positioning skip_bundle_adjustment
        skip_retriangulation track_intra_image_consistency_threshold track_required_tracks_per_view
        track_min_num_views_per_track track_max_num_views_per_track keep_max_num_tracks gp_use_gpu gp_gpu_index
        gp_optimize_positions gp_optimize_points gp_optimize_scales gp_loss_function_scale gp_max_num_iterations
        ba_refine_sensor_from_rig ba_refine_rig_from_world ba_refine_points3D ba_min_track_length ba_ceres_use_gpu
        ba_ceres_gpu_index ba_ceres_loss_function_scale ba_ceres_max_num_iterations ba_gpu_index
        ba_skip_fixed_rotation_stage ba_skip_joint_optimization_stage tri_complete_max_reproj_error
        tri_merge_max_reproj_error tri_min_angle ra_use_stratified max_angular_reproj_error_deg
        max_normalized_reproj_error min_tri_angle_deg refine_sensor_from_rig
        """,
    "ViewGraphCalib.": "thres_lower_ratio thres_higher_ratio thres_two_view_error",
    "RelPoseEstimation.": "max_epipolar_error",
    "TrackEstablishment.": "min_num_tracks_per_view min_num_view_per_track max_num_view_per_track max_num_tracks",
    "GlobalPositioning.": """
        use_gpu gpu_index optimize_positions optimize_points optimize_scales thres_loss_function max_num_iterations
        """,
    "BundleAdjustment.": """
        use_gpu gpu_index optimize_rig_poses optimize_rotations optimize_translation optimize_points
        thres_loss_function max_num_iterations
        """,
    "Triangulation.": "complete_max_reproj_error merge_max_reproj_error min_angle min_num_matches",
    "Thresholds.": """
        max_angle_error max_reprojection_error min_triangulation_angle max_epipolar_error_E max_epipolar_error_F
        max_epipolar_error_H min_inlier_ratio
        """,
    "PosePrior.": """
        use_robust_loss_on_prior_position prior_position_loss_threshold
        prior_position_scaled_loss_factor alignment_ransac_max_error
        """,
}

IGNORED = frozenset(f"--{family}{name}" for family, names in _IGNORED.items() for name in names.split())
"""Flags of the other mappers that have no counterpart here."""

OBEYED = (
    *REFINE_FOCAL_LENGTH,
    *REFINE_PRINCIPAL_POINT,
    *REFINE_EXTRA_PARAMS,
    *REFINE_INTRINSICS,
    *FIX_EXISTING_FRAMES,
    *USE_PRIOR_POSITION,
    *OVERWRITE_PRIORS_COVARIANCE,
    *PRIOR_POSITION_STD_X,
    *PRIOR_POSITION_STD_Y,
    *PRIOR_POSITION_STD_Z,
    *USE_PRIOR_GRAVITY,
    *EXTRACT_COLORS,
    *NUM_THREADS,
    *RANDOM_SEED,
    *MIN_NUM_MATCHES,
    *ROTATION_GATE,
)
"""Flags of the other mappers that are obeyed."""


REFUSED = {
    "--image_list_path": "all images of the database are mapped",
    "--Mapper.image_list_path": "all images of the database are mapped",
    "--GlobalMapper.image_list_path": "all images of the database are mapped",
    "--Mapper.max_extra_param": "no image is left out for the parameters of its camera",
    "--Mapper.constant_rig_list_path": "all cameras are adjusted",
    "--Mapper.constant_camera_list_path": "all intrinsics are adjusted, or none (--ba_refine_focal_length and others)",
}
"""Flags of the other mappers that restrict a job, and what is done here in place of it: a model made without the
restriction would look as if it had been obeyed."""


class UnknownArgumentError(Exception):
    """An argument that none of the mappers knows, or that is not to be had here; the message says which."""


def ignored_flags(arguments: Sequence[str]) -> list[str]:
    """Names of the known flags among left-over arguments, with their values taken off.

    Parameters
    ----------
    arguments : sequence of str
        What the command line holds beside the flags that are obeyed.

    Returns
    -------
    list of str
        ``--Mapper.max_num_models`` and the like, in the order given.

    Raises
    ------
    UnknownArgumentError
        For the first argument that is no known flag, or restricts the job as is not done here.
    """
    flags: list[str] = []
    position = 0
    while position < len(arguments):
        name, separator, value = arguments[position].partition("=")
        if name not in IGNORED:
            raise UnknownArgumentError(_unknown(name))
        flags.append(name)
        position += 1
        if not separator and position < len(arguments) and not arguments[position].startswith("--"):
            value = arguments[position]
            position += 1
        if name in REFUSED and parse_boolean(value) is not False:
            raise UnknownArgumentError(f"{name} is not supported: {REFUSED[name]}")
    return flags


def misspelt_flag(arguments: Sequence[str]) -> str | None:
    """The first long flag with one dash, whose letters would count as flags of their own; None where there is none."""
    for argument in arguments:
        name = argument.partition("=")[0]
        if name.startswith("-") and not name.startswith("--") and "_" in name:
            return name
    return None


def parse_boolean(value: str) -> bool | None:
    """True or false as COLMAP spells them (0, 1, true, false, in any case); None for anything else."""
    return {"1": True, "true": True, "0": False, "false": False}.get(value.lower())


def _unknown(name: str) -> str:
    if not name.startswith("-"):
        return f"unexpected argument {name!r}"
    close = get_close_matches(name, [*OBEYED, *sorted(IGNORED)], n=1)
    return f"no such option: {name}" + (f"; did you mean {close[0]}?" if close else "")
