"""The flags of the verbs, written once: name, type, default, help, and COLMAP's names; and the options that they make.

A verb takes one parameter per group of flags. `takes_flags` lays the groups out as the single flags that typer reads
from a function's signature, and `feature_options` and `mapping_options` turn groups into the library's options.
"""

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from colmap_vg.cli import colmap_flags
from colmap_vg.options import (
    CameraMode,
    Extractor,
    FeatureOptions,
    MappingOptions,
    Matching,
    Method,
    OutlierFilter,
    Quality,
    ReadOptions,
    RigLayout,
    RotationAveraging,
    SolveOptions,
)

ImagePath = Annotated[Path, typer.Option("--image_path", help="Folder of photographs, searched recursively.")]
MapperImagePath = Annotated[
    Path | None, typer.Option("--image_path", help="Folder of the photographs. Without it, points have no colour.")
]
DatabasePath = Annotated[
    Path, typer.Option("--database_path", help="COLMAP database with verified matches. It is never modified.")
]
ImagePathOfJob = Annotated[
    Path | None, typer.Option("--image_path", help="Folder of the photographs. Default: that of the job.")
]
DatabasePathOfJob = Annotated[
    Path | None,
    typer.Option("--database_path", help="The job's database, never modified. Default: that of the job."),
]
OutputPath = Annotated[
    Path, typer.Option("--output_path", help="Folder for models and summary. It is created if missing.")
]


def _switch(*names: str, help: str) -> Any:
    """A flag that takes 0, 1, true or false, as COLMAP's do."""
    return typer.Option(*names, metavar="0|1", parser=_boolean, help=help)


def _boolean(value: str | bool) -> bool:
    parsed = colmap_flags.parse_boolean(str(value))
    if parsed is None:
        raise typer.BadParameter(f"takes 0, 1, true or false, found {value!r}")
    return parsed


def _numbers(text: str | tuple[float, ...]) -> tuple[float, ...]:
    if isinstance(text, tuple):
        return text
    try:
        return tuple(float(part) for part in text.split(",")) if text.strip() else ()
    except ValueError:
        raise typer.BadParameter(f"takes numbers separated by commas, found {text!r}") from None


Switch = Any
"""A boolean whose flag has a value; typer gives ``bool`` a flag without one."""
ReportSwitch = Annotated[
    Switch, _switch("--report", help="Write OUT/report.html: a page to look at the result, without a network.")
]
RefIsGps = Annotated[
    Switch, _switch("--ref_is_gps", help="Known positions are latitude, longitude and height (WGS84).")
]
InputPath = Annotated[
    Path | None,
    typer.Option("--input_path", help="Folder of a model of some of the images. The others are added to it."),
]
RefineIntrinsics = Annotated[
    Switch,
    _switch(*colmap_flags.REFINE_INTRINSICS, help="Refine focal lengths and distortion coefficients (GLOMAP's flag)."),
]


@dataclass(frozen=True, kw_only=True)
class FeatureFlags:
    """Flags of `FeatureOptions`."""

    features: Annotated[
        Extractor,
        typer.Option(
            "--features",
            help="SIFT of OpenCV or of COLMAP, which takes four times as long. Their features match each other.",
        ),
    ] = FeatureOptions.features
    camera_model: Annotated[
        str, typer.Option("--camera_model", help="COLMAP camera model of new cameras, such as PINHOLE or OPENCV.")
    ] = FeatureOptions.camera_model
    camera_params: Annotated[
        Any,
        typer.Option(
            "--camera_params",
            metavar="F,CX,CY,...",
            parser=_numbers,
            show_default=False,
            help="Known calibration, in the order of the camera model, in pixels.",
        ),
    ] = FeatureOptions.camera_params
    camera_mode: Annotated[
        CameraMode,
        typer.Option("--camera_mode", help="Which images share a camera: all, those of a folder, or none."),
    ] = FeatureOptions.camera_mode
    quality: Annotated[
        Quality,
        typer.Option(
            "--quality",
            help="Preset of image size, number of features and pairs to match. Flags for these override it.",
        ),
    ] = "high"
    matching: Annotated[
        Matching | None,
        typer.Option(
            "--matching",
            help="Which pairs of images are matched. auto: all pairs up to 20 images, selected pairs beyond.",
        ),
    ] = None
    sequential_overlap: Annotated[
        int,
        typer.Option(
            "--sequential_overlap",
            help="Number of following images that each image is matched with, in sequential matching.",
        ),
    ] = FeatureOptions.sequential_overlap
    image_list_path: Annotated[
        Path | None,
        typer.Option("--image_list_path", help="Text file with one image name per line. Only these images are used."),
    ] = None
    mask_path: Annotated[
        Path | None,
        typer.Option(
            "--mask_path",
            help="Folder of masks, NAME.png or NAME.jpg for image NAME. No features are taken where a mask is black.",
        ),
    ] = None
    rigs: Annotated[
        RigLayout,
        typer.Option(
            "--rigs",
            help="folders: one rig, with a folder for each camera; photographs taken at once have the same name.",
        ),
    ] = FeatureOptions.rigs
    rig_config_path: Annotated[
        Path | None, typer.Option("--rig_config_path", help="COLMAP's rig configuration file, rig_config.json.")
    ] = None
    max_image_size: Annotated[
        int | None,
        typer.Option(
            "--max_image_size",
            help="Longer side to which larger images are scaled down, in pixels. -1: 3200.",
        ),
    ] = None
    max_num_features: Annotated[
        int | None, typer.Option("--max_num_features", help="Maximum number of SIFT features per image.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class ReadFlags:
    """Flags of `ReadOptions`."""

    trust_focal_lengths: Annotated[
        Literal["auto", "always", "never"],
        typer.Option("--trust_focal_lengths", help="Whether to trust the focal lengths stored in the database."),
    ] = ReadOptions.trust_focal_lengths
    excluded_pairs_path: Annotated[
        Path | None,
        typer.Option(
            "--excluded_pairs_path", help="Text file with two image names per line. These pairs are not used."
        ),
    ] = None
    trusted_pairs_path: Annotated[
        Path | None,
        typer.Option(
            "--trusted_pairs_path", help="Text file with two image names per line. No filter drops these pairs."
        ),
    ] = None
    min_num_inliers: Annotated[
        int,
        typer.Option(*colmap_flags.MIN_NUM_MATCHES, help="Minimum number of inlier matches of a pair that is used."),
    ] = ReadOptions.min_num_inliers


@dataclass(frozen=True, kw_only=True)
class SolveFlags:
    """Flags of `SolveOptions`."""

    method: Annotated[
        Method, typer.Option("--method", help="Method that solves camera positions from the viewing graph.")
    ] = SolveOptions.method
    rotation_averaging: Annotated[
        RotationAveraging, typer.Option("--rotation_averaging", help="Method of rotation averaging.")
    ] = SolveOptions.rotation_averaging
    outlier_filter: Annotated[
        OutlierFilter, typer.Option("--outlier_filter", help="Filter of false translation directions.")
    ] = SolveOptions.outlier_filter
    rotation_gate_deg: Annotated[
        float,
        typer.Option(
            *colmap_flags.ROTATION_GATE,
            help="Drop pairs whose rotation is further than this from the averaged ones, in degrees. 0: keep all.",
        ),
    ] = SolveOptions.rotation_gate_deg
    edge_weights: Annotated[
        Literal["information", "inliers", "unit"], typer.Option("--edge_weights", help="How pairs are weighted.")
    ] = SolveOptions.edge_weights
    use_prior_gravity: Annotated[
        Switch,
        _switch(*colmap_flags.USE_PRIOR_GRAVITY, help="Refine rotations by the measured gravity in the database."),
    ] = "1"
    covariances: Annotated[
        Switch,
        _switch(
            "--covariances",
            help="Write the standard deviations of camera poses, before bundle adjustment, to images.csv.",
        ),
    ] = "0"
    refine_focal_lengths: Annotated[
        Switch, _switch(*colmap_flags.REFINE_FOCAL_LENGTH, help="Refine focal lengths.")
    ] = "1"


@dataclass(frozen=True, kw_only=True)
class ModelFlags:
    """Flags of `MappingOptions`."""

    ba_refine_principal_point: Annotated[
        Switch, _switch(*colmap_flags.REFINE_PRINCIPAL_POINT, help="Refine principal points.")
    ] = "0"
    ba_refine_extra_params: Annotated[
        Switch, _switch(*colmap_flags.REFINE_EXTRA_PARAMS, help="Refine distortion coefficients.")
    ] = "1"
    share_cameras: Annotated[
        Switch,
        _switch(
            "--share_cameras",
            help="Share intrinsics between images with the same initial calibration, unless they show different ones.",
        ),
    ] = "1"
    fix_existing_frames: Annotated[
        Switch,
        _switch(
            *colmap_flags.FIX_EXISTING_FRAMES,
            help="Keep the poses and calibrations of the model of --input_path as they are.",
        ),
    ] = "1"
    use_prior_position: Annotated[
        Switch,
        _switch(
            *colmap_flags.USE_PRIOR_POSITION,
            help="Georeference models by the GPS or other measured positions in the database.",
        ),
    ] = "1"
    overwrite_priors_covariance: Annotated[
        Switch,
        _switch(
            *colmap_flags.OVERWRITE_PRIORS_COVARIANCE,
            help="Weigh measured positions by --prior_position_std_x, _y and _z instead of the database's covariances.",
        ),
    ] = "0"
    prior_position_std_x: Annotated[
        float,
        typer.Option(
            *colmap_flags.PRIOR_POSITION_STD_X,
            help="Standard deviation of measured positions, metres east, or the unit of Cartesian ones along x.",
        ),
    ] = 1.0
    prior_position_std_y: Annotated[
        float, typer.Option(*colmap_flags.PRIOR_POSITION_STD_Y, help="The same, metres north, or along y.")
    ] = 1.0
    prior_position_std_z: Annotated[
        float, typer.Option(*colmap_flags.PRIOR_POSITION_STD_Z, help="The same, metres up, or along z.")
    ] = 1.0
    extract_colors: Annotated[
        Switch, _switch(*colmap_flags.EXTRACT_COLORS, help="Colour points from the photographs.")
    ] = "1"


@dataclass(frozen=True, kw_only=True)
class JobFlags:
    """Flags of every job."""

    num_threads: Annotated[int, typer.Option(*colmap_flags.NUM_THREADS, help="Number of threads. -1: all cores.")] = -1
    random_seed: Annotated[
        int,
        typer.Option(
            *colmap_flags.RANDOM_SEED,
            help="Seed of all random choices. The same seed with one thread gives the same result.",
        ),
    ] = 0
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace models in the output folder.")] = False
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted job: reuse its finished stages.")
    ] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print every event and COLMAP's own log.")] = False
    log_json: Annotated[
        str | None,
        typer.Option(
            "--log_json",
            metavar="FILE|-",
            help="Write each event as a line of JSON, and last the result. -: to standard output, in place of text.",
        ),
    ] = None

    @property
    def seed(self) -> int:
        """The seed; COLMAP's -1 asks for the default."""
        return 0 if self.random_seed == -1 else self.random_seed


def takes_flags(verb: Callable[..., None]) -> Callable[..., None]:
    """The verb with each parameter that is a group of flags laid out as the flags of the group.

    Parameters
    ----------
    verb : callable
        Function whose parameters are annotated: with a dataclass of flags, or as typer reads it.

    Returns
    -------
    callable
        The same function of single flags, in the order of the parameters and of the groups' fields.
    """
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: list[Parameter] = []
    for parameter in signature(verb).parameters.values():
        if parameter.name in groups:
            parameters += _parameters(groups[parameter.name])
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name], kind=Parameter.KEYWORD_ONLY))

    @wraps(verb)
    def with_single_flags(**values: Any) -> None:
        grouped = {
            name: group(**{field.name: values.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        verb(**values, **grouped)

    del with_single_flags.__wrapped__  # its signature is not this function's
    with_single_flags.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    with_single_flags.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_single_flags


def _parameters(group: Any) -> list[Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        Parameter(
            field.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]


def feature_options(flags: FeatureFlags, job: JobFlags) -> FeatureOptions:
    """Options of features and matching: those of the preset, and on top the flags that were given."""
    given = {name: value for name, value in vars(flags).items() if value is not None and name != "quality"}
    return FeatureOptions.of_quality(flags.quality, **given, num_threads=job.num_threads, random_seed=job.seed)


def mapping_options(
    read: ReadFlags, solve: SolveFlags, job: JobFlags, model: ModelFlags | None = None
) -> MappingOptions:
    """Options of a job on a database, from reading to the model."""
    refine = {"refine_focal_lengths": "auto" if solve.refine_focal_lengths else "never"}
    return MappingOptions(
        read=ReadOptions(**vars(read), random_seed=job.seed),
        solve=SolveOptions(**{**vars(solve), **refine}, random_seed=job.seed),
        **({} if model is None else vars(model)),
        ba_refine_focal_length=solve.refine_focal_lengths,
        overwrite=job.overwrite,
        num_threads=job.num_threads,
        random_seed=job.seed,
    )
