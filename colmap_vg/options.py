"""Options of reading, solving, feature extraction and mapping: frozen dataclasses, checked on creation."""

from dataclasses import dataclass, field, fields
from os import PathLike
from typing import Any, Literal, Self, get_args, get_origin, get_type_hints

from colmap_vg.errors import OptionError

Method = Literal[
    "epipolar", "1C", "1O", "2C", "2O", "2W", "cls", "cle1", "cross", "orthogonal", "lud", "shapefit", "bata"
]
OutlierFilter = Literal["robust", "1dsfm", "none"]
RotationAveraging = Literal["robust", "chordal"]
Quality = Literal["low", "medium", "high", "extreme"]
CameraMode = Literal["auto", "single", "per_folder", "per_image"]
Extractor = Literal["opencv", "colmap"]
RigLayout = Literal["none", "folders"]
Matching = Literal["auto", "exhaustive", "selected", "sequential", "spatial"]
ExportFormat = Literal["text", "binary", "ply", "nerfstudio", "bundler", "tum", "g2o", "splat"]


def _number(default: float, low: float, high: float = float("inf")) -> Any:
    return field(default=default, metadata={"low": low, "high": high})


class _Checked:
    """Base class that checks the literals, booleans, numbers and ranges of a dataclass's fields on creation."""

    @classmethod
    def given(cls, options: Self | None) -> Self:
        """Return the options, or the defaults for None.

        Raises
        ------
        OptionError
            `options` has another type, for instance dict or one of pycolmap's.
        """
        if options is None:
            return cls()
        if not isinstance(options, cls):
            hint = (
                f"write {cls.__name__}(**options)" if isinstance(options, dict) else f"use a colmap_vg.{cls.__name__}"
            )
            raise OptionError(f"options must be a {cls.__name__}, found a {type(options).__name__}: {hint}")
        return options

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for f in fields(self):  # type: ignore[arg-type]
            value, hint, where = getattr(self, f.name), hints[f.name], f"{type(self).__name__}.{f.name}"
            if get_origin(hint) is Literal and value not in get_args(hint):
                raise OptionError(f"{where} is {value!r}; choose one of {', '.join(map(str, get_args(hint)))}")
            if hint is bool and not isinstance(value, bool):
                raise OptionError(f"{where} must be True or False, found {value!r}")
            if hint in (int, float) and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise OptionError(f"{where} must be a number, found {value!r}")
            if hint is int and not isinstance(value, int):
                raise OptionError(f"{where} must be an integer, found {value!r}")
            low, high = f.metadata.get("low"), f.metadata.get("high")
            if low is not None and not low <= value <= high:
                raise OptionError(f"{where} is {value}, outside its range {low} to {high}")


@dataclass(frozen=True)
class ReadOptions(_Checked):
    """Options of reading a viewing graph from a database."""

    min_num_inliers: int = _number(15, 5)  # verified matches; edges with fewer are in the graph but not used
    trust_focal_lengths: Literal["auto", "always", "never"] = "auto"  # auto: decided from the two-view geometries
    find_distortion: bool = True  # estimate a radial term for cameras without distortion whose model has one
    max_matches_per_pose: int = _number(1000, 5)  # matches that refine an edge's pose, evenly from its list
    max_num_inliers_per_edge: int = _number(0, 0)  # matches kept as bearings per edge, evenly from its list; 0: all
    excluded_pairs_path: str | PathLike[str] | None = None  # file with two image names per line: pairs not to use
    trusted_pairs_path: str | PathLike[str] | None = None  # file with two image names per line: pairs never dropped
    random_seed: int = _number(0, 0)


@dataclass(frozen=True)
class SolveOptions(_Checked):
    """Options of solving a viewing graph.

    The paper's pipeline is chordal rotation averaging, no rotation gate, and the 1DSfM filter.
    """

    method: Method = "epipolar"
    rotation_averaging: RotationAveraging = "robust"
    use_prior_gravity: bool = True  # refine averaged rotations by the measured gravity in the database
    certify_rotations: bool = False  # warn whether chordal rotations are a global optimum (by an eigenvalue)
    outlier_filter: OutlierFilter = "robust"
    rotation_gate_deg: float = _number(10.0, 0.0, 180.0)  # degrees; edges with a larger error are dropped; 0: no gate
    one_dsfm_threshold: float = _number(0.1, 0.0)  # maximum broken weight, mean absolute projection, dimensionless
    one_dsfm_num_directions: int = _number(48, 1)  # random projection directions
    direction_gate_deg: float = _number(15.0, 0.0, 180.0)  # degrees; gate of the robust direction filter; 0: no gate
    edge_weights: Literal["unit", "inliers", "information"] = "information"  # inliers: sqrt(number), planar a third
    accelerate: bool = True  # Anderson acceleration of 1C, 1O, 2C, 2O, 2W; same fixed point
    max_num_iterations: int = _number(1000, 1)  # outer iterations of 1C, 1O, 2C, 2O, 2W
    convergence_tolerance: float = _number(1e-6, 0.0, 1.0)  # relative change of positions between outer iterations
    covariances: bool = False  # compute those of poses in the epipolar adjustment; adds a fifth to the solver's time
    refine_focal_lengths: Literal["auto", "always", "never"] = "auto"  # auto: cameras whose focal length was not given
    adjustment_tolerance: float = _number(1e-5, 0.0, 1.0)  # relative change of cost that ends the epipolar adjustment
    max_matches_per_edge: int = _number(500, 0)  # matches in the epipolar adjustment, spread over the image; 0: all
    max_tracks_per_triplet: int = _number(60, 0)  # tracks through three images in the epipolar adjustment; 0: all
    random_seed: int = _number(0, 0)


@dataclass(frozen=True)
class FeatureOptions(_Checked):
    """Options of feature extraction and matching. Features are SIFT, computed on the CPU."""

    features: Extractor = "opencv"  # whose SIFT; both match with one another
    camera_model: str = "SIMPLE_RADIAL"
    camera_params: tuple[float, ...] = ()  # in the order of COLMAP's model, pixels; empty: from EXIF, else guessed
    camera_mode: CameraMode = "auto"  # auto: COLMAP's, which shares a camera only if EXIF data agree
    matching: Matching = "auto"  # auto: exhaustive for up to 20 images, else selected (by the largest features)
    image_list_path: str | PathLike[str] | None = None  # file with one image name per line; None: all in the folder
    mask_path: str | PathLike[str] | None = None  # folder of masks: NAME.png or NAME.jpg of image NAME; black is masked
    rigs: RigLayout = "none"  # folders: one rig, a folder for each camera, and photographs of one name are a frame
    rig_config_path: str | PathLike[str] | None = None  # COLMAP's rig configuration file (JSON)
    max_image_size: int = _number(-1, -1)  # pixels, longer side; larger images are resized; -1: 3200
    max_num_features: int = _number(8192, 1)  # per image
    sequential_overlap: int = _number(10, 1)  # images; each is matched with this many that follow it
    num_threads: int = _number(-1, -1)  # -1: all cores
    random_seed: int = _number(0, 0)

    @classmethod
    def of_quality(cls, quality: Quality, **options: Any) -> "FeatureOptions":
        """Make the options of a preset, with the given ones replaced.

        Raises
        ------
        OptionError
            The preset is unknown, or an option is outside its range.
        """
        if quality not in QUALITIES:
            raise OptionError(f"quality is {quality!r}; choose one of {', '.join(QUALITIES)}")
        return cls(**{**QUALITIES[quality], **options})


QUALITIES: dict[Quality, dict[str, Any]] = {
    "low": {"max_image_size": 1000, "max_num_features": 2048},
    "medium": {"max_image_size": 1600, "max_num_features": 4096},
    "high": {},
    "extreme": {"max_image_size": 100_000, "max_num_features": 16384, "matching": "exhaustive"},
}
"""Values of `FeatureOptions` for each preset; other fields keep their defaults."""


@dataclass(frozen=True)
class MappingOptions(_Checked):
    """Options of mapping a database."""

    read: ReadOptions = field(default_factory=ReadOptions)
    solve: SolveOptions = field(default_factory=SolveOptions)
    ba_refine_focal_length: bool = True
    ba_refine_principal_point: bool = False
    ba_refine_extra_params: bool = True
    share_cameras: bool = True  # share intrinsics between images of the same size and initial calibration
    extract_colors: bool = True
    fix_existing_frames: bool = True  # keep poses and calibrations of a model to start from (input_path) as they are
    use_prior_position: bool = True  # georeference models by the measured positions in the database
    overwrite_priors_covariance: bool = False  # use the standard deviations below instead of the database's covariances
    prior_position_std_x: float = _number(1.0, 1e-9)  # metres east, or the unit of Cartesian positions
    prior_position_std_y: float = _number(1.0, 1e-9)  # metres north
    prior_position_std_z: float = _number(1.0, 1e-9)  # metres up
    overwrite: bool = False
    num_threads: int = _number(-1, -1)  # -1: all cores
    random_seed: int = _number(0, 0)  # of all stages; replaces those of read and solve
