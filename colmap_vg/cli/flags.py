"""Flags of the verbs: name, type, and what each does."""

from pathlib import Path
from typing import Annotated, get_args

import typer

from colmap_vg.cli import colmap_flags
from colmap_vg.options import Matching as MatchingOption
from colmap_vg.options import Method as SolverMethod
from colmap_vg.options import Quality as QualityPreset

METHODS = "|".join(get_args(SolverMethod))

ImagePath = Annotated[Path, typer.Option("--image_path", help="Folder of photographs, searched recursively.")]
MapperImagePath = Annotated[
    Path | None, typer.Option("--image_path", help="Folder of the photographs. Without it, points have no colour.")
]
DatabasePath = Annotated[
    Path, typer.Option("--database_path", help="COLMAP database with verified matches. It is never modified.")
]
OutputPath = Annotated[
    Path, typer.Option("--output_path", help="Folder for models and summary. It is created if missing.")
]
CameraModel = Annotated[
    str, typer.Option("--camera_model", help="COLMAP camera model of new cameras, such as PINHOLE or OPENCV.")
]
CameraParams = Annotated[
    str,
    typer.Option(
        "--camera_params", metavar="F,CX,CY,...", help="Known calibration, in the order of the camera model, in pixels."
    ),
]
CameraMode = Annotated[
    str,
    typer.Option(
        "--camera_mode",
        metavar="auto|single|per_folder|per_image",
        help="Which images share a camera: all, those of a folder, or none.",
    ),
]
Quality = Annotated[
    str,
    typer.Option(
        "--quality",
        metavar="|".join(get_args(QualityPreset)),
        help="Preset of image size, number of features and pairs to match. Flags for these override it.",
    ),
]
Matching = Annotated[
    str | None,
    typer.Option(
        "--matching",
        metavar="|".join(get_args(MatchingOption)),
        help="Which pairs of images are matched. auto: all pairs up to 20 images, selected pairs beyond.",
    ),
]
SequentialOverlap = Annotated[
    int,
    typer.Option(
        "--sequential_overlap",
        help="Number of following images that each image is matched with, in sequential matching.",
    ),
]
ImageListPath = Annotated[
    Path | None,
    typer.Option("--image_list_path", help="Text file with one image name per line. Only these images are used."),
]
MaskPath = Annotated[
    Path | None,
    typer.Option(
        "--mask_path",
        help="Folder of masks, NAME.png or NAME.jpg for image NAME. No features are taken where a mask is black.",
    ),
]
MaxImageSize = Annotated[
    int | None,
    typer.Option(
        "--max_image_size", help="Longer side to which larger images are scaled down, in pixels. -1: COLMAP's default."
    ),
]
MaxNumFeatures = Annotated[
    int | None, typer.Option("--max_num_features", help="Maximum number of SIFT features per image.")
]
Method = Annotated[
    str, typer.Option("--method", metavar=METHODS, help="Method that solves camera positions from the viewing graph.")
]
RotationAveraging = Annotated[
    str, typer.Option("--rotation_averaging", metavar="robust|chordal", help="Method of rotation averaging.")
]
OutlierFilter = Annotated[
    str, typer.Option("--outlier_filter", metavar="robust|1dsfm|none", help="Filter of false translation directions.")
]
RotationGate = Annotated[
    float,
    typer.Option(
        *colmap_flags.ROTATION_GATE,
        help="Drop pairs whose rotation is further than this from the averaged ones, in degrees. 0: keep all.",
    ),
]
EdgeWeights = Annotated[
    str, typer.Option("--edge_weights", metavar="information|inliers|unit", help="How pairs are weighted.")
]
TrustFocalLengths = Annotated[
    str,
    typer.Option(
        "--trust_focal_lengths",
        metavar="auto|always|never",
        help="Whether to trust the focal lengths stored in the database.",
    ),
]
MinNumMatches = Annotated[
    int, typer.Option(*colmap_flags.MIN_NUM_MATCHES, help="Minimum number of inlier matches of a pair that is used.")
]
RefineFocalLength = Annotated[
    str, typer.Option(*colmap_flags.REFINE_FOCAL_LENGTH, metavar="0|1", help="Refine focal lengths.")
]
RefinePrincipalPoint = Annotated[
    str, typer.Option(*colmap_flags.REFINE_PRINCIPAL_POINT, metavar="0|1", help="Refine principal points.")
]
RefineExtraParams = Annotated[
    str, typer.Option(*colmap_flags.REFINE_EXTRA_PARAMS, metavar="0|1", help="Refine distortion coefficients.")
]
RefineIntrinsics = Annotated[
    str,
    typer.Option(
        *colmap_flags.REFINE_INTRINSICS,
        metavar="0|1",
        help="Refine focal lengths and distortion coefficients (GLOMAP's flag).",
    ),
]
ExtractColors = Annotated[
    str, typer.Option(*colmap_flags.EXTRACT_COLORS, metavar="0|1", help="Colour points from the photographs.")
]
ShareCameras = Annotated[
    str,
    typer.Option(
        "--share_cameras",
        metavar="0|1",
        help="Share intrinsics between images with the same initial calibration, unless they show different ones.",
    ),
]
NumThreads = Annotated[int, typer.Option(*colmap_flags.NUM_THREADS, help="Number of threads. -1: all cores.")]
RandomSeed = Annotated[
    int,
    typer.Option(
        *colmap_flags.RANDOM_SEED,
        help="Seed of all random choices. The same seed with one thread gives the same result.",
    ),
]
CovariancesFlag = Annotated[
    str,
    typer.Option(
        "--covariances",
        metavar="0|1",
        help="Write the standard deviations of camera poses, before bundle adjustment, to images.csv.",
    ),
]
ExcludedPairs = Annotated[
    Path | None,
    typer.Option("--excluded_pairs_path", help="Text file with two image names per line. These pairs are not used."),
]
TrustedPairs = Annotated[
    Path | None,
    typer.Option("--trusted_pairs_path", help="Text file with two image names per line. No filter drops these pairs."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace models in the output folder.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted job: reuse its finished stages.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print every event and COLMAP's own log.")]
