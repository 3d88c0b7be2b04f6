"""Options of reading, solving and mapping: frozen dataclasses, checked when they are made."""

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
Matching = Literal["auto", "exhaustive", "selected", "sequential", "spatial"]


def _number(default: float, low: float, high: float = float("inf")) -> Any:
    return field(default=default, metadata={"low": low, "high": high})


class _Checked:
    """Checks literals, booleans, integers and ranges of a frozen dataclass's fields."""

    @classmethod
    def given(cls, options: Self | None) -> Self:
        """The options, or the defaults for None.

        Raises
        ------
        OptionError
            They are of another kind, for instance a dict or pycolmap's.
        """
        if options is None:
            return cls()
        if not isinstance(options, cls):
            hint = (
                f"write {cls.__name__}(**options)" if isinstance(options, dict) else f"make a colmap_vg.{cls.__name__}"
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
    """How a viewing graph is read from a database."""

    min_num_inliers: int = _number(15, 5)  # matches; edges with fewer are in the graph but not used
    trust_focal_lengths: Literal["auto", "always", "never"] = "auto"  # auto: decided from the two-view geometries
    find_distortion: bool = True  # a radial term for cameras of a radial model that have no distortion, if matches tell
    max_num_inliers_per_edge: int = _number(0, 0)  # matches kept as bearings per edge, spread over the image; 0: all
    excluded_pairs_path: str | PathLike[str] | None = None  # file with two image names a line: pairs not to be used
    trusted_pairs_path: str | PathLike[str] | None = None  # the same: pairs that no filter may drop
    random_seed: int = _number(0, 0)


@dataclass(frozen=True)
class SolveOptions(_Checked):
    """How a viewing graph is solved. The paper's chain: chordal rotation averaging, no gate, 1DSfM."""

    method: Method = "epipolar"
    rotation_averaging: RotationAveraging = "robust"
    certify_rotations: bool = False  # say in the caveats whether chordal rotations are the global optimum (eigenvalue)
    outlier_filter: OutlierFilter = "robust"
    rotation_gate_deg: float = _number(10.0, 0.0, 180.0)  # degrees; edges beyond it are dropped; 0: no gate
    one_dsfm_threshold: float = _number(0.1, 0.0)  # broken weight, mean |projection|
    one_dsfm_num_directions: int = _number(48, 1)
    direction_gate_deg: float = _number(15.0, 0.0, 180.0)  # degrees; robust filter of directions; 0: no gate
    edge_weights: Literal["unit", "inliers", "information"] = "information"  # inliers: sqrt(number), planar a third
    accelerate: bool = True  # Anderson acceleration of those of 1C, 1O, 2C, 2O, 2W; same fixed point
    max_num_iterations: int = _number(1000, 1)  # outer iterations of 1C, 1O, 2C, 2O, 2W
    convergence_tolerance: float = _number(1e-6, 0.0, 1.0)  # relative change of positions between outer iterations
    covariances: bool = False  # of the cameras that the epipolar adjustment finds; a fifth of the solver's time more
    refine_focal_lengths: Literal["auto", "always", "never"] = "auto"  # auto: cameras whose focal was not given
    max_matches_per_edge: int = _number(500, 0)  # matches in the epipolar adjustment, spread over the image; 0: all
    random_seed: int = _number(0, 0)


@dataclass(frozen=True)
class FeatureOptions(_Checked):
    """How a folder of photographs becomes a database. Features are SIFT, on the CPU."""

    camera_model: str = "SIMPLE_RADIAL"
    camera_params: tuple[float, ...] = ()  # in the model's order, pixels; empty: from EXIF, else guessed
    camera_mode: CameraMode = "auto"  # auto: COLMAP's, which shares a camera only where EXIF says so
    matching: Matching = "auto"  # exhaustive, in folders of more than 20 images selected: by their largest features
    image_list_path: str | PathLike[str] | None = None  # file with one image name a line; None: all of the folder
    mask_path: str | PathLike[str] | None = None  # folder of masks: NAME.png or NAME.jpg of image NAME; black hides
    max_image_size: int = _number(-1, -1)  # pixels, longer side; larger images are shrunk for extraction; -1: COLMAP's
    max_num_features: int = _number(8192, 1)  # per image
    sequential_overlap: int = _number(10, 1)  # images; each is matched with so many followers
    num_threads: int = _number(-1, -1)  # -1: all cores
    random_seed: int = _number(0, 0)

    @classmethod
    def of_quality(cls, quality: Quality, **options: Any) -> "FeatureOptions":
        """The options of a preset, save for those that are given.

        Raises
        ------
        OptionError
            There is no such preset, or an option is outside its range.
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
"""Fields of `FeatureOptions` for each preset; the others keep their defaults."""


@dataclass(frozen=True)
class MappingOptions(_Checked):
    """How a database becomes models."""

    read: ReadOptions = field(default_factory=ReadOptions)
    solve: SolveOptions = field(default_factory=SolveOptions)
    ba_refine_focal_length: bool = True
    ba_refine_principal_point: bool = False
    ba_refine_extra_params: bool = True
    share_cameras: bool = True  # photographs of one size that start with one calibration share a lens
    extract_colors: bool = True
    overwrite: bool = False
    num_threads: int = _number(-1, -1)  # -1: all cores
    random_seed: int = _number(0, 0)  # of all stages, in place of those in read and solve
