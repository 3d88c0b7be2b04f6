"""The verbs of ``colmap-vg`` and their flags. What they do is in `colmap_vg.cli.jobs`, loaded when a verb runs."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from colmap_vg._version import __version__
from colmap_vg.cli import colmap_flags, flags
from colmap_vg.cli.reporter import Reporter
from colmap_vg.cli.wording import with_flags
from colmap_vg.errors import ColmapVgError, OptionError
from colmap_vg.options import FeatureOptions, MappingOptions, ReadOptions, SolveOptions

USAGE, INTERRUPTED = 2, 130
"""Exit codes of wrong usage, and of a job ended by Ctrl-C, as shells give it (128 + SIGINT)."""

DEFAULTS = MappingOptions()

app = typer.Typer(
    name="colmap-vg",
    help="Structure-from-Motion on the viewing graph: photographs or a COLMAP database in, a COLMAP model out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its tables cut long flag names off
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def version_only(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.", is_eager=True)] = False,
) -> None:
    """Structure-from-Motion on the viewing graph: photographs or a COLMAP database in, a COLMAP model out."""
    if version:
        typer.echo(f"colmap-vg {__version__}")
        raise typer.Exit


@app.command()
def run(
    image_path: flags.ImagePath,
    output_path: flags.OutputPath,
    camera_model: flags.CameraModel = "SIMPLE_RADIAL",
    camera_params: flags.CameraParams = "",
    camera_mode: flags.CameraMode = "auto",
    quality: flags.Quality = "high",
    matching: flags.Matching = None,
    sequential_overlap: flags.SequentialOverlap = FeatureOptions.sequential_overlap,
    image_list_path: flags.ImageListPath = None,
    mask_path: flags.MaskPath = None,
    max_image_size: flags.MaxImageSize = None,
    max_num_features: flags.MaxNumFeatures = None,
    method: flags.Method = DEFAULTS.solve.method,
    rotation_averaging: flags.RotationAveraging = DEFAULTS.solve.rotation_averaging,
    outlier_filter: flags.OutlierFilter = DEFAULTS.solve.outlier_filter,
    rotation_gate_deg: flags.RotationGate = DEFAULTS.solve.rotation_gate_deg,
    edge_weights: flags.EdgeWeights = DEFAULTS.solve.edge_weights,
    covariances: flags.CovariancesFlag = "0",
    trust_focal_lengths: flags.TrustFocalLengths = DEFAULTS.read.trust_focal_lengths,
    excluded_pairs_path: flags.ExcludedPairs = None,
    trusted_pairs_path: flags.TrustedPairs = None,
    min_num_matches: flags.MinNumMatches = DEFAULTS.read.min_num_inliers,
    ba_refine_focal_length: flags.RefineFocalLength = "1",
    ba_refine_principal_point: flags.RefinePrincipalPoint = "0",
    ba_refine_extra_params: flags.RefineExtraParams = "1",
    share_cameras: flags.ShareCameras = "1",
    extract_colors: flags.ExtractColors = "1",
    num_threads: flags.NumThreads = -1,
    random_seed: flags.RandomSeed = 0,
    overwrite: flags.Overwrite = False,
    resume: flags.Resume = False,
    quiet: flags.Quiet = False,
    verbose: flags.Verbose = False,
) -> None:
    """From a folder of photographs to models: features, matching, viewing graph, triangulation, bundle adjustment."""
    with _job(quiet, verbose) as reporter:
        given = {"matching": matching, "max_image_size": max_image_size, "max_num_features": max_num_features}
        features = FeatureOptions.of_quality(
            quality,  # type: ignore[arg-type]  # checked there
            **{name: value for name, value in given.items() if value is not None},
            camera_model=camera_model,
            camera_params=_numbers("--camera_params", camera_params),
            camera_mode=camera_mode,
            image_list_path=image_list_path,
            mask_path=mask_path,
            sequential_overlap=sequential_overlap,
            num_threads=num_threads,
            random_seed=_seed(random_seed),
        )
        options = _mapping_options(
            _read_options(trust_focal_lengths, min_num_matches, excluded_pairs_path, trusted_pairs_path, random_seed),
            _solve_options(
                method,
                rotation_averaging,
                outlier_filter,
                rotation_gate_deg,
                edge_weights,
                covariances,
                ba_refine_focal_length,
                random_seed,
            ),
            ba_refine_focal_length,
            ba_refine_principal_point,
            ba_refine_extra_params,
            share_cameras,
            extract_colors,
            overwrite,
            num_threads,
            random_seed,
        )
        import colmap_vg.cli.jobs as jobs

        jobs.run(image_path, output_path, features, options, resume, reporter)


@app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def mapper(
    context: typer.Context,
    database_path: flags.DatabasePath,
    output_path: flags.OutputPath,
    image_path: flags.MapperImagePath = None,
    method: flags.Method = DEFAULTS.solve.method,
    rotation_averaging: flags.RotationAveraging = DEFAULTS.solve.rotation_averaging,
    outlier_filter: flags.OutlierFilter = DEFAULTS.solve.outlier_filter,
    rotation_gate_deg: flags.RotationGate = DEFAULTS.solve.rotation_gate_deg,
    edge_weights: flags.EdgeWeights = DEFAULTS.solve.edge_weights,
    covariances: flags.CovariancesFlag = "0",
    trust_focal_lengths: flags.TrustFocalLengths = DEFAULTS.read.trust_focal_lengths,
    excluded_pairs_path: flags.ExcludedPairs = None,
    trusted_pairs_path: flags.TrustedPairs = None,
    min_num_matches: flags.MinNumMatches = DEFAULTS.read.min_num_inliers,
    ba_refine_focal_length: flags.RefineFocalLength = "1",
    ba_refine_principal_point: flags.RefinePrincipalPoint = "0",
    ba_refine_extra_params: flags.RefineExtraParams = "1",
    optimize_intrinsics: flags.RefineIntrinsics = "",
    share_cameras: flags.ShareCameras = "1",
    extract_colors: flags.ExtractColors = "1",
    num_threads: flags.NumThreads = -1,
    random_seed: flags.RandomSeed = 0,
    overwrite: flags.Overwrite = False,
    resume: flags.Resume = False,
    quiet: flags.Quiet = False,
    verbose: flags.Verbose = False,
) -> None:
    """From a COLMAP database to models. Takes the flags of colmap's and glomap's mappers.

    Of those flags the ones listed here are obeyed; the others are accepted with a warning that names them.
    """
    if optimize_intrinsics:
        ba_refine_focal_length = ba_refine_extra_params = optimize_intrinsics
    try:
        ignored = colmap_flags.ignored_flags(context.args)
    except colmap_flags.UnknownArgumentError as error:
        raise typer.BadParameter(str(error)) from None
    with _job(quiet, verbose) as reporter:
        options = _mapping_options(
            _read_options(trust_focal_lengths, min_num_matches, excluded_pairs_path, trusted_pairs_path, random_seed),
            _solve_options(
                method,
                rotation_averaging,
                outlier_filter,
                rotation_gate_deg,
                edge_weights,
                covariances,
                ba_refine_focal_length,
                random_seed,
            ),
            ba_refine_focal_length,
            ba_refine_principal_point,
            ba_refine_extra_params,
            share_cameras,
            extract_colors,
            overwrite,
            num_threads,
            random_seed,
        )
        for flag in ignored:
            reporter.warn(f"{flag} has no counterpart in colmap-vg and is ignored")
        import colmap_vg.cli.jobs as jobs

        jobs.mapper(database_path, image_path, output_path, options, resume, reporter)


@app.command()
def solve(
    database_path: flags.DatabasePath,
    output_path: flags.OutputPath,
    method: flags.Method = DEFAULTS.solve.method,
    rotation_averaging: flags.RotationAveraging = DEFAULTS.solve.rotation_averaging,
    outlier_filter: flags.OutlierFilter = DEFAULTS.solve.outlier_filter,
    rotation_gate_deg: flags.RotationGate = DEFAULTS.solve.rotation_gate_deg,
    edge_weights: flags.EdgeWeights = DEFAULTS.solve.edge_weights,
    covariances: flags.CovariancesFlag = "0",
    trust_focal_lengths: flags.TrustFocalLengths = DEFAULTS.read.trust_focal_lengths,
    excluded_pairs_path: flags.ExcludedPairs = None,
    trusted_pairs_path: flags.TrustedPairs = None,
    min_num_matches: flags.MinNumMatches = DEFAULTS.read.min_num_inliers,
    ba_refine_focal_length: flags.RefineFocalLength = "1",
    num_threads: flags.NumThreads = -1,  # noqa: ARG001  -- of every verb; the solver itself has one thread
    random_seed: flags.RandomSeed = 0,
    overwrite: flags.Overwrite = False,
    resume: flags.Resume = False,
    quiet: flags.Quiet = False,
    verbose: flags.Verbose = False,
) -> None:
    """The viewing graph only: OUT/0 holds poses without points."""
    with _job(quiet, verbose) as reporter:
        read = _read_options(trust_focal_lengths, min_num_matches, excluded_pairs_path, trusted_pairs_path, random_seed)
        options = _solve_options(
            method,
            rotation_averaging,
            outlier_filter,
            rotation_gate_deg,
            edge_weights,
            covariances,
            ba_refine_focal_length,
            random_seed,
        )
        import colmap_vg.cli.jobs as jobs

        jobs.solve(database_path, output_path, read, options, overwrite, resume, reporter)


@app.command()
def demo(
    output_path: flags.OutputPath,
    num_images: Annotated[int, typer.Option("--num_images", min=3, help="Photographs to render.")] = 24,
    seed: Annotated[int, typer.Option("--seed", "--random_seed", min=0, help="Of scene, cameras and noise.")] = 0,
    num_threads: flags.NumThreads = -1,
    overwrite: flags.Overwrite = False,
    resume: flags.Resume = False,
    quiet: flags.Quiet = False,
    verbose: flags.Verbose = False,
) -> None:
    """Render photographs of a scene from known cameras, make a model of them, and compare it with the truth."""
    with _job(quiet, verbose) as reporter:
        import colmap_vg.cli.jobs as jobs

        jobs.demo(output_path, num_images, seed, num_threads, overwrite, resume, reporter)


@app.command()
def explain(
    output_path: Annotated[Path, typer.Option("--output_path", help="Folder of a finished job.")],
    image: Annotated[
        str | None, typer.Option("--image", metavar="NAME", help="What became of this image, and why.")
    ] = None,
    pair: Annotated[
        tuple[str, str] | None, typer.Option("--pair", metavar="A B", help="What became of this pair, and why.")
    ] = None,
) -> None:
    """Say what a finished job made of its images and pairs, and why."""
    if image is not None and pair is not None:
        raise typer.BadParameter("--image and --pair are two questions: ask one")
    with _job(False, False) as reporter:
        import colmap_vg.cli.jobs as jobs

        for line in jobs.explain(output_path, image, pair):
            reporter.say(line)


def main() -> None:
    """Entry point of ``colmap-vg`` and ``python -m colmap_vg``."""
    single = colmap_flags.misspelt_flag(sys.argv[1:])
    if single is not None:
        typer.echo(f"error: no such option: {single}; did you mean -{single}? (see --help)", err=True)
        sys.exit(USAGE)
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


@contextmanager
def _job(quiet: bool, verbose: bool) -> Iterator[Reporter]:
    """A reporter for the job, whose expected ends become exit codes with one line on standard error."""
    if quiet and verbose:
        raise typer.BadParameter("--quiet and --verbose contradict each other")
    try:
        with Reporter(quiet, verbose) as reporter:
            yield reporter
    except OptionError as error:
        raise typer.BadParameter(_one_line(error)) from error
    except ColmapVgError as error:
        typer.echo(f"error: {_one_line(error)}", err=True)
        raise typer.Exit(1) from error
    except KeyboardInterrupt:
        typer.echo("interrupted; finished stages are kept: go on with --resume", err=True)
        raise typer.Exit(INTERRUPTED) from None


def _one_line(error: BaseException) -> str:
    return with_flags(" ".join(str(error).split()))


def _boolean(flag: str, value: str) -> bool:
    parsed = colmap_flags.parse_boolean(value)
    if parsed is None:
        raise typer.BadParameter(f"{flag} takes 0, 1, true or false, found {value!r}")
    return parsed


def _numbers(flag: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",")) if text.strip() else ()
    except ValueError:
        raise typer.BadParameter(f"{flag} takes numbers separated by commas, found {text!r}") from None


def _seed(random_seed: int) -> int:
    return 0 if random_seed == -1 else random_seed  # COLMAP's -1 asks for its default


def _read_options(
    trust_focal_lengths: str,
    min_num_matches: int,
    excluded_pairs_path: Path | None,
    trusted_pairs_path: Path | None,
    random_seed: int,
) -> ReadOptions:
    return ReadOptions(
        excluded_pairs_path=excluded_pairs_path,
        trusted_pairs_path=trusted_pairs_path,
        min_num_inliers=min_num_matches,
        trust_focal_lengths=trust_focal_lengths,  # type: ignore[arg-type]
        random_seed=_seed(random_seed),
    )


def _solve_options(
    method: str,
    rotation_averaging: str,
    outlier_filter: str,
    rotation_gate_deg: float,
    edge_weights: str,
    covariances: str,
    ba_refine_focal_length: str,
    random_seed: int,
) -> SolveOptions:
    refine = _boolean("--ba_refine_focal_length", ba_refine_focal_length)
    return SolveOptions(
        method=method,  # type: ignore[arg-type]
        rotation_averaging=rotation_averaging,  # type: ignore[arg-type]
        outlier_filter=outlier_filter,  # type: ignore[arg-type]
        rotation_gate_deg=rotation_gate_deg,
        edge_weights=edge_weights,  # type: ignore[arg-type]
        covariances=_boolean("--covariances", covariances),
        refine_focal_lengths="auto" if refine else "never",
        random_seed=_seed(random_seed),
    )


def _mapping_options(
    read: ReadOptions,
    solve: SolveOptions,
    ba_refine_focal_length: str,
    ba_refine_principal_point: str,
    ba_refine_extra_params: str,
    share_cameras: str,
    extract_colors: str,
    overwrite: bool,
    num_threads: int,
    random_seed: int,
) -> MappingOptions:
    return MappingOptions(
        read=read,
        solve=solve,
        ba_refine_focal_length=_boolean("--ba_refine_focal_length", ba_refine_focal_length),
        ba_refine_principal_point=_boolean("--ba_refine_principal_point", ba_refine_principal_point),
        ba_refine_extra_params=_boolean("--ba_refine_extra_params", ba_refine_extra_params),
        share_cameras=_boolean("--share_cameras", share_cameras),
        extract_colors=_boolean("--extract_colors", extract_colors),
        overwrite=overwrite,
        num_threads=num_threads,
        random_seed=_seed(random_seed),
    )
