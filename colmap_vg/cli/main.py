"""The verbs of ``colmap-vg`` and their flags. What they do is in `colmap_vg.cli.jobs`, loaded when a verb runs."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from colmap_vg._version import __version__
from colmap_vg.cli import colmap_flags, flags
from colmap_vg.cli.flags import takes_flags
from colmap_vg.cli.json_log import FAILED, INTERRUPTED, USAGE, JsonLog
from colmap_vg.cli.reporter import Reporter
from colmap_vg.cli.wording import one_line
from colmap_vg.errors import ColmapVgError, OptionError
from colmap_vg.options import ExportFormat


class Backend(StrEnum):
    """What the explorer is shown by."""

    VISER = "viser"
    OPEN3D = "open3d"


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
@takes_flags
def run(
    image_path: flags.ImagePath,
    output_path: flags.OutputPath,
    features: flags.FeatureFlags,
    solve: flags.SolveFlags,
    read: flags.ReadFlags,
    model: flags.ModelFlags,
    report: flags.ReportSwitch = "1",
    *,
    job: flags.JobFlags,
) -> None:
    """From a folder of photographs to models: features, matching, viewing graph, triangulation, bundle adjustment."""
    with _job(job.quiet, job.verbose, job.log_json) as reporter:
        feature_options, options = flags.feature_options(features, job), flags.mapping_options(read, solve, job, model)
        import colmap_vg.cli.jobs as jobs

        jobs.run(image_path, output_path, feature_options, options, job.resume, reporter, report)


@app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
@takes_flags
def mapper(
    context: typer.Context,
    database_path: flags.DatabasePath,
    output_path: flags.OutputPath,
    image_path: flags.MapperImagePath = None,
    *,
    input_path: flags.InputPath = None,
    solve: flags.SolveFlags,
    read: flags.ReadFlags,
    model: flags.ModelFlags,
    optimize_intrinsics: flags.RefineIntrinsics = None,
    report: flags.ReportSwitch = "1",
    job: flags.JobFlags,
) -> None:
    """From a COLMAP database to models. Takes the flags of colmap's and glomap's mappers.

    Of those flags the ones listed here are obeyed; the others are accepted with a warning that names them.
    """
    if optimize_intrinsics is not None:
        solve = replace(solve, refine_focal_lengths=optimize_intrinsics)
        model = replace(model, ba_refine_extra_params=optimize_intrinsics)
    try:
        ignored = colmap_flags.ignored_flags(context.args)
    except colmap_flags.UnknownArgumentError as error:
        raise typer.BadParameter(str(error)) from None
    with _job(job.quiet, job.verbose, job.log_json) as reporter:
        options = flags.mapping_options(read, solve, job, model)
        for flag in ignored:
            reporter.warn(f"{flag} has no counterpart in colmap-vg and is ignored")
        import colmap_vg.cli.jobs as jobs

        jobs.mapper(database_path, image_path, output_path, options, job.resume, reporter, report, input_path)


@app.command()
@takes_flags
def solve(
    database_path: flags.DatabasePath,
    output_path: flags.OutputPath,
    solve: flags.SolveFlags,
    read: flags.ReadFlags,
    job: flags.JobFlags,
) -> None:
    """The viewing graph only: OUT/0 holds poses without points."""
    with _job(job.quiet, job.verbose, job.log_json) as reporter:
        options = flags.mapping_options(read, solve, job)
        import colmap_vg.cli.jobs as jobs

        jobs.solve(database_path, output_path, options.read, options.solve, job.overwrite, job.resume, reporter)


@app.command()
@takes_flags
def demo(
    output_path: flags.OutputPath,
    num_images: Annotated[int, typer.Option("--num_images", min=3, help="Number of photographs to render.")] = 24,
    *,
    report: flags.ReportSwitch = "1",
    job: flags.JobFlags,
) -> None:
    """Render photographs of a scene from known cameras, make a model of them, and compare it with the truth."""
    with _job(job.quiet, job.verbose, job.log_json) as reporter:
        import colmap_vg.cli.jobs as jobs

        jobs.demo(output_path, num_images, job.seed, job.num_threads, job.overwrite, job.resume, reporter, report)


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
    with _job() as reporter:
        import colmap_vg.cli.jobs as jobs

        for line in jobs.explain(output_path, image, pair):
            reporter.say(line)


@app.command()
@takes_flags
def align(
    input_path: Annotated[Path, typer.Option("--input_path", help="Folder of a model. It is not changed.")],
    output_path: flags.OutputPath,
    ref_images_path: Annotated[
        Path | None, typer.Option("--ref_images_path", help="Text file with a line NAME X Y Z for each known camera.")
    ] = None,
    ref_points_path: Annotated[
        Path | None,
        typer.Option(
            "--ref_points_path", help="Text file with a line POINT X Y Z IMAGE U V for each view of a survey point."
        ),
    ] = None,
    ref_is_gps: flags.RefIsGps = "0",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace models in the output folder.")] = False,
) -> None:
    """Move a model into the frame of known camera positions or survey points: OUT/0."""
    if (ref_images_path is None) == (ref_points_path is None):
        raise typer.BadParameter("give either --ref_images_path or --ref_points_path")
    with _job() as reporter:
        import colmap_vg.cli.jobs as jobs

        jobs.align(input_path, output_path, ref_images_path, ref_points_path, ref_is_gps, overwrite, reporter)


@app.command()
def export(
    input_path: Annotated[
        Path, typer.Option("--input_path", help="Folder of a model, or of a finished job. It is not changed.")
    ],
    output_path: Annotated[
        Path, typer.Option("--output_path", help="A file for ply, tum and g2o, a folder for the other formats.")
    ],
    format: Annotated[
        ExportFormat,
        typer.Option("--format", help="Format of the output. splat: undistorted images and pinhole cameras."),
    ],
    image_path: Annotated[
        Path | None,
        typer.Option(
            "--image_path", help="Folder of the photographs, for nerfstudio and splat. Default: that of the job."
        ),
    ] = None,
    model: Annotated[
        int | None, typer.Option("--model", min=0, help="Which of the job's models. Default: the first.")
    ] = None,
    max_image_size: Annotated[
        int | None,
        typer.Option("--max_image_size", min=1, help="Longer side of the undistorted images of splat, in pixels."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier export.")] = False,
) -> None:
    """Write a model in the format of another program: undistorted images for splatting, nerfstudio, PLY and others."""
    with _job() as reporter:
        import colmap_vg.cli.jobs as jobs

        jobs.export(input_path, output_path, format, image_path, model, max_image_size, overwrite, reporter)


@app.command()
def report(
    output_path: Annotated[Path, typer.Option("--output_path", help="Folder of a finished job.")],
    image_path: flags.ImagePathOfJob = None,
    database_path: flags.DatabasePathOfJob = None,
) -> None:
    """Write OUT/report.html: a page to look at the result of a finished job, without a network."""
    with _job() as reporter:
        import colmap_vg.cli.jobs as jobs

        jobs.report(output_path, image_path, database_path, reporter)


@app.command()
def view(
    output_path: Annotated[Path, typer.Option("--output_path", help="Folder of a finished job. It is not changed.")],
    image_path: flags.ImagePathOfJob = None,
    database_path: flags.DatabasePathOfJob = None,
    lists_path: Annotated[
        Path | None,
        typer.Option("--lists_path", help="Folder that lists of pairs are saved to. Default: OUT_lists beside OUT."),
    ] = None,
    backend: Annotated[
        Backend, typer.Option("--backend", help="A page in the browser, or a window of Open3D, to look only.")
    ] = Backend.VISER,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on. Others than this machine's own open the job to others.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="First port that is tried. 0: any.")] = 8080,
) -> None:
    """Explore a finished job: exclude or trust pairs and images, solve again, and save the lists for mapper."""
    with _job() as reporter:
        from colmap_vg.cli.exploring import view

        view(output_path, image_path, database_path, lists_path, backend, host, port, reporter)


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
def _job(quiet: bool = False, verbose: bool = False, log_json: str | None = None) -> Iterator[Reporter]:
    """A reporter for the job, whose expected ends become exit codes with one line on standard error."""
    if quiet and verbose:
        raise typer.BadParameter("--quiet and --verbose contradict each other")
    try:
        if log_json is None:
            with Reporter(quiet, verbose) as reporter:
                yield reporter
        else:
            with JsonLog(log_json) as log, Reporter(quiet or log.to_stdout, verbose, log) as reporter:
                yield reporter
    except OptionError as error:
        raise typer.BadParameter(one_line(error)) from error
    except ColmapVgError as error:
        typer.echo(f"error: {one_line(error)}", err=True)
        raise typer.Exit(FAILED) from error
    except KeyboardInterrupt:
        typer.echo("interrupted; finished stages are kept: go on with --resume", err=True)
        raise typer.Exit(INTERRUPTED) from None
