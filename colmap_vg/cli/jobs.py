"""What the verbs do: the library's jobs, with their results shown and written to ``summary.json``."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pycolmap

from colmap_vg.cli.closing import closing_lines
from colmap_vg.cli.reporter import Reporter
from colmap_vg.errors import DatabaseError, DataFileError, MappingError, OutputError
from colmap_vg.events import StageLog
from colmap_vg.jobs.bridges import all_bridges
from colmap_vg.jobs.image_folder import DATABASE_NAME, make_database
from colmap_vg.jobs.job_record import recorded_job
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.jobs.output_folder import existing_models, publish_models, refuse_models, stage_models, work_folder
from colmap_vg.jobs.summary import (
    damaged_summary,
    edge_summary,
    georeference_line,
    image_summary,
    job_summary,
    model_summary,
    plain,
    read_summary,
    told_bridges,
    write_summary,
)
from colmap_vg.jobs.verdict_tables import (
    explain_image,
    explain_job,
    explain_pair,
    image_names,
    read_tables,
    verdict_tables,
    write_tables,
)
from colmap_vg.mapping.weak_cuts import WeakCut
from colmap_vg.options import ExportFormat, FeatureOptions, MappingOptions, ReadOptions, SolveOptions
from colmap_vg.report.page import write_report
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph

DONE_BEFORE = "{}: this job came to its end before; nothing is left to do"


def configure_colmap_log(verbose: bool) -> None:
    """Keep COLMAP's own log off standard error, where the one line of an error belongs."""
    level = pycolmap.logging.Level.INFO if verbose else pycolmap.logging.Level.FATAL
    pycolmap.logging.minloglevel = level.value


def run(
    image_path: Path,
    output_path: Path,
    features: FeatureOptions,
    options: MappingOptions,
    resume: bool,
    reporter: Reporter,
    with_report: bool = True,
) -> None:
    """From a folder of photographs to models."""
    configure_colmap_log(reporter.verbose)
    log = StageLog(reporter.on_event)
    asked = {"image_path": image_path, "output_path": output_path, "features": features, "mapping": options}
    with recorded_job(output_path, "run", asked, image_path, overwrite=options.overwrite, resume=resume) as job:
        if job.finished:
            _done_before(output_path, reporter)
            return
        options = replace(options, overwrite=job.overwrite)
        result = make_database(image_path, output_path, features, log, overwrite=options.overwrite, resume=resume)
        mapped = map_database(output_path / DATABASE_NAME, image_path, output_path, options, log)
        skipped = {file.name: file.reason for file in result.skipped}
        _finish("run", {**asked, "resume": resume}, mapped, output_path, reporter, with_report, skipped)


def mapper(
    database_path: Path,
    image_path: Path | None,
    output_path: Path,
    options: MappingOptions,
    resume: bool,
    reporter: Reporter,
    with_report: bool = True,
    input_path: Path | None = None,
) -> None:
    """From a database to models, or from a database and a model to a larger one."""
    configure_colmap_log(reporter.verbose)
    asked = {"database_path": database_path, "image_path": image_path, "output_path": output_path, "mapping": options}
    if input_path is not None:
        asked["input_path"] = input_path
    with recorded_job(output_path, "mapper", asked, database_path, overwrite=options.overwrite, resume=resume) as job:
        if job.finished:
            _done_before(output_path, reporter)
            return
        options = replace(options, overwrite=job.overwrite)
        log = StageLog(reporter.on_event)
        mapped = map_database(database_path, image_path, output_path, options, log, input_path)
        _finish("mapper", {**asked, "resume": resume}, mapped, output_path, reporter, with_report)


def solve(
    database_path: Path,
    output_path: Path,
    read: ReadOptions,
    options: SolveOptions,
    overwrite: bool,
    resume: bool,
    reporter: Reporter,
) -> None:
    """The viewing graph only: a model of poses without points."""
    configure_colmap_log(reporter.verbose)
    asked = {"database_path": database_path, "output_path": output_path, "read": read, "solve": options}
    with recorded_job(output_path, "solve", asked, database_path, overwrite=overwrite, resume=resume) as job:
        if job.finished:
            _done_before(output_path, reporter)
            return
        _solve(
            database_path,
            output_path,
            read,
            options,
            job.overwrite,
            reporter,
            {**asked, "overwrite": overwrite, "resume": resume},
        )


def _solve(
    database_path: Path,
    output_path: Path,
    read: ReadOptions,
    options: SolveOptions,
    overwrite: bool,
    reporter: Reporter,
    asked: Mapping[str, object],
) -> None:
    from colmap_vg.colmap_io.database import check_database
    from colmap_vg.colmap_io.reconstruction import loaded_cache, write_model
    from colmap_vg.mapping.posed_model import posed_model
    from colmap_vg.reading.read import read_with_caveats
    from colmap_vg.solver.solve import solve_view_graph

    log = StageLog(reporter.on_event)
    check_database(database_path)
    refuse_models(output_path, overwrite)
    with log.stage("view graph"):
        graph, caveats = read_with_caveats(database_path, read)
        for caveat in caveats:
            log.warn(caveat)
        log.result(f"{len(graph.image_ids)} images, {len(graph.edges)} edges")
    with log.stage("solve"):
        solution = solve_view_graph(graph, options)
        for caveat in solution.caveats:
            log.warn(caveat)
        log.result(solution.message)
    if not solution.registered.any():
        raise MappingError(f"no pose could be solved from {database_path}: {solution.message}")
    with log.stage("write"), work_folder(output_path, overwrite) as work:
        staged = stage_models(work, int(solution.component.max(initial=-1)) + 1)
        with loaded_cache(database_path, work, read.min_num_inliers, graph=graph) as (cache, _):
            for component, folder in enumerate(staged):
                write_model(posed_model(cache, solution, graph, component), folder)
        log.result(", ".join(map(str, publish_models(staged, output_path))))
    content = job_summary("solve", asked, reporter.records, reporter.warnings)
    content |= _verdicts(graph, solution, output_path, {})
    write_summary(output_path, content)
    names = image_names(graph)
    reporter.finish(len(staged), int((solution.component >= 0).sum()))
    reporter.say(f"{int(solution.registered.sum())} of {len(names)} images registered: {output_path / '0'}")


def demo(
    output_path: Path,
    num_images: int,
    seed: int,
    num_threads: int,
    overwrite: bool,
    resume: bool,
    reporter: Reporter,
    with_report: bool = True,
) -> None:
    """Render a scene, run it, and compare with the truth."""
    from colmap_vg.demo import run_demo

    configure_colmap_log(reporter.verbose)
    asked = {"output_path": output_path, "num_images": num_images, "seed": seed, "num_threads": num_threads}
    with recorded_job(output_path, "demo", asked, None, overwrite=overwrite, resume=resume) as job:
        if job.finished:
            _done_before(output_path, reporter)
            return
        comparison, mapped = run_demo(
            output_path,
            num_images=num_images,
            seed=seed,
            num_threads=num_threads,
            overwrite=job.overwrite,
            resume=resume,
            on_event=reporter.on_event,
        )
        _finish(
            "demo",
            {**asked, "overwrite": overwrite, "resume": resume},
            mapped,
            output_path,
            reporter,
            with_report,
            further={"comparison": plain(comparison)},
        )
        reporter.say(comparison.summary)


def explain(output_path: Path, image: str | None, pair: tuple[str, str] | None) -> list[str]:
    """What a finished job made of everything, of one image, or of one pair."""
    tables = read_tables(output_path)
    if pair is not None:
        return explain_pair(tables, *pair)
    return explain_job(tables, told_bridges(output_path)) if image is None else explain_image(tables, image)


def align(
    input_path: Path,
    output_path: Path,
    positions_path: Path | None,
    points_path: Path | None,
    by_gps: bool,
    overwrite: bool,
    reporter: Reporter,
) -> None:
    """A copy of a model in the frame of known positions."""
    from colmap_vg.jobs.align import align

    configure_colmap_log(reporter.verbose)
    found = align(
        input_path,
        output_path,
        positions_path=positions_path,
        points_path=points_path,
        by_gps=by_gps,
        overwrite=overwrite,
        log=StageLog(reporter.on_event),
    )
    reporter.say(f"{output_path / '0'}: {georeference_line(asdict(found))}")


def export(
    input_path: Path,
    output_path: Path,
    format: ExportFormat,
    image_path: Path | None,
    model: int | None,
    max_image_size: int | None,
    overwrite: bool,
    reporter: Reporter,
) -> None:
    """A model in the format of another program."""
    from colmap_vg.exports.export import export_model

    configure_colmap_log(reporter.verbose)
    done = export_model(
        input_path,
        output_path,
        format,
        image_path=image_path,
        model=model,
        max_image_size=max_image_size,
        overwrite=overwrite,
    )
    notes = "".join(f"; {note}" for note in done.notes)
    reporter.say(f"{done.path}: {done.num_images} images, {done.num_points} points{notes}")


def report(output_path: Path, image_path: Path | None, database_path: Path | None, reporter: Reporter) -> None:
    """The report of a finished job, from its files."""
    configure_colmap_log(reporter.verbose)
    reporter.say(f"report: {write_report(output_path, image_path, database_path)}")


def _finish(
    verb: str,
    asked: Mapping[str, object],
    mapped: MappingResult,
    output_path: Path,
    reporter: Reporter,
    with_report: bool,
    skipped: Mapping[str, str] | None = None,
    further: Mapping[str, object] | None = None,
) -> None:
    """Write the summary and the report of a mapping job, and say what came out."""
    content = job_summary(verb, asked, reporter.records, reporter.warnings)
    content |= _verdicts(mapped.graph, mapped.solution, output_path, skipped or {}, mapped.weak_cuts)
    content["models"] = [
        model_summary(output_path / str(index), model)
        | {"agreement": plain(mapped.solution.agreement[index]), "georeference": plain(mapped.georeferences[index])}
        for index, model in mapped.models.items()
    ]
    content |= further or {}
    write_summary(output_path, content)
    reporter.finish(len(mapped.models), int((mapped.solution.component >= 0).sum()))
    for line in closing_lines(content, output_path):
        reporter.say(line)
    if with_report:
        _report(output_path, content, reporter)


def _done_before(output_path: Path, reporter: Reporter) -> None:
    """Say that the job came to its end before, and with what."""
    try:
        registered = int(read_summary(output_path)["images"]["num_registered"])
    except (KeyError, TypeError, ValueError) as error:
        raise damaged_summary(output_path) from error
    reporter.finish(len([path for path in existing_models(output_path) if path != output_path]), registered)
    reporter.say(DONE_BEFORE.format(output_path))


def _report(output_path: Path, content: Mapping[str, object], reporter: Reporter) -> None:
    """Write the report of a finished job; where it fails the job keeps its models, and the summary says so."""
    try:
        reporter.say(f"report: {write_report(output_path)}")
    except (DatabaseError, DataFileError, OutputError) as error:
        reporter.warn(f"The report was not written: {error}")
        write_summary(output_path, {**content, "warnings": list(reporter.warnings)})


def _verdicts(
    graph: ViewGraph,
    solution: PoseSolution,
    output_path: Path,
    skipped: Mapping[str, str],
    weak_cuts: Sequence[Sequence[WeakCut]] = (),
) -> dict[str, object]:
    """The summary's part on images and pairs; the tables of all of them are written beside it."""
    write_tables(output_path, verdict_tables(graph, solution, skipped))
    return {
        "status": str(solution.status),
        "images": image_summary(
            [*image_names(graph), *skipped],
            [*solution.image_verdicts.tolist(), *skipped.values()],
            [*(solution.component >= 0).tolist(), *[False] * len(skipped)],
        ),
        "edges": edge_summary(solution.edge_verdicts.tolist(), solution.edge_kept.tolist()),
        "bridges": plain(all_bridges(graph, solution, weak_cuts)),
    }
