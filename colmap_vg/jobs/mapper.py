"""From a COLMAP database to models: read the viewing graph, solve it, build the models and write them atomically."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.colmap_io.database import check_database
from colmap_vg.colmap_io.quiet import quiet_colmap
from colmap_vg.colmap_io.reconstruction import loaded_cache, write_model
from colmap_vg.colmap_io.shared_cameras import shared_cameras, with_database_cameras
from colmap_vg.errors import MappingError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.jobs.finished_solution import solution_of_models, solution_of_reading, with_edges_of_models
from colmap_vg.jobs.graph import lenses_to_read_with, read_job_graph, solve_job_graph, solve_options
from colmap_vg.jobs.joining import BuiltModel, compared_images, join_models
from colmap_vg.jobs.output_folder import publish_models, refuse_models, stage_models, work_folder
from colmap_vg.mapping.build import (
    CONVERGED_COST_RATIO,
    MAX_NUM_ROUNDS,
    adjust_once_more,
    build_model,
)
from colmap_vg.mapping.colors import extract_colors
from colmap_vg.mapping.extension import extend_model, read_input_model
from colmap_vg.mapping.georeference import Georeference, georeference, level_by_gravity
from colmap_vg.mapping.pair_agreement import PairRotations
from colmap_vg.mapping.posed_model import posed_model, scale_is_uncertain, with_placed_sensors
from colmap_vg.mapping.second_opinion import PointEvidence, best_arrangement, point_evidence
from colmap_vg.mapping.weak_cuts import WeakCut, weak_cuts
from colmap_vg.options import MappingOptions
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.solve import solve_view_graph
from colmap_vg.solver.state import described

SHARED_LENS_COST_RATIO = 0.8
"""Ratio of final to initial cost of bundle adjustment with one calibration per camera, below which shared calibrations
are given up. With a single lens it was 0.98 to 0.99 for images with many observations, 0.89 for those with few."""
FALSE_PAIRS = (EdgeVerdict.EXCLUDED, EdgeVerdict.ROTATION_OUTLIER)
"""Verdicts of pairs that are excluded from triangulation: the user's, and those with a rotation error beyond noise."""


@dataclass(frozen=True, eq=False)
class MappingResult:
    """Result of a mapping job.

    Attributes
    ----------
    models : dict of int to pycolmap.Reconstruction
        As written, the largest first.
    graph : ViewGraph
    solution : PoseSolution
        Poses, focal factors, image verdicts, agreement and residuals are those of the finished models, in their frames;
        edge verdicts, radial terms and covariances are those of the viewing graph's solution.
    weak_cuts : tuple of tuples of WeakCut
        For each model, the cuts that few pairs cross.
    georeferences : tuple of Georeference or None
        Of each model that lies in the frame of measured positions.
    """

    models: dict[int, "pycolmap.Reconstruction"]
    graph: ViewGraph
    solution: PoseSolution
    weak_cuts: tuple[tuple[WeakCut, ...], ...] = ()
    georeferences: tuple[Georeference | None, ...] = ()


def view_graph_mapping(
    database_path: str | PathLike[str],
    image_path: str | PathLike[str] | None,
    output_path: str | PathLike[str],
    options: MappingOptions | None = None,
    on_event: Callable[[StageEvent], None] | None = None,
    *,
    input_path: str | PathLike[str] | None = None,
) -> dict[int, "pycolmap.Reconstruction"]:
    """Make models from a database of verified matches, as ``pycolmap.global_mapping`` does.

    Parameters
    ----------
    database_path : path
        Never modified.
    image_path : path or None
        Folder of the photographs, for the colours of points; without it they are black.
    output_path : path
        Models are written to ``output_path/0``, ``output_path/1``, ..., each atomically.
    options : MappingOptions, optional
    on_event : callable, optional
        Called with a `StageEvent` whenever a stage starts, progresses, ends or warns. An exception from it stops the
        job, which then writes no model, and is passed on.
    input_path : path, optional
        Folder of a model of some of the images, which the others are added to, in its frame.

    Returns
    -------
    dict of int to pycolmap.Reconstruction
        The models, the largest first.

    Raises
    ------
    DatabaseError
        The database is missing, damaged, or holds no verified pairs.
    OutputError
        The output cannot be written or already holds a model.
    MappingError
        No model could be made.
    OptionError
        `options` is not a `MappingOptions`.
    CancelledError
        Or what else `on_event` raises.
    """
    options = MappingOptions.given(options)
    with quiet_colmap():
        return map_database(database_path, image_path, output_path, options, StageLog(on_event), input_path).models


def map_database(
    database_path: str | PathLike[str],
    image_path: str | PathLike[str] | None,
    output_path: str | PathLike[str],
    options: MappingOptions,
    log: StageLog,
    input_path: str | PathLike[str] | None = None,
) -> MappingResult:
    """Make models as :func:`view_graph_mapping` does, with the caller's log; also return the graph and the solution.

    Parameters
    ----------
    database_path, image_path, output_path, options
        As for :func:`view_graph_mapping`.
    log : StageLog
    input_path : path, optional

    Returns
    -------
    MappingResult

    Raises
    ------
    ColmapVgError
        As for :func:`view_graph_mapping`.
    """
    check_database(database_path)
    refuse_models(output_path, options.overwrite)
    with work_folder(output_path, options.overwrite) as work:
        given = None if input_path is None else read_input_model(input_path)
        graph = read_job_graph(database_path, options, log, given)
        if given is None:
            graph, solution, built = _solved_models(database_path, work, graph, options, log)
        else:
            solution, built = solution_of_reading(graph), [_extended(database_path, work, graph, given, options, log)]
        cuts = _weak_cuts(database_path, graph, built, log)
        with log.stage("write"):
            staged = stage_models(work, len(built))
            for folder, model in zip(staged, built, strict=True):
                if model.georeference is None and given is None:
                    metric = graph.rigs is not None and graph.rigs.is_metric
                    model.reconstruction.normalize(fixed_scale=metric)
                if options.extract_colors:
                    extract_colors(model.reconstruction, image_path, log)
                write_model(model.reconstruction, folder)
                log.progress(str(folder.name))
            published = publish_models(staged, output_path)
            log.result(", ".join(map(str, published)))
    models = {index: model.reconstruction for index, model in enumerate(built)}
    finished = solution_of_models(
        solution, graph, [model.reconstruction for model in built], [model.result for model in built], cuts
    )
    if given is not None:
        finished = with_edges_of_models(finished, graph)
    return MappingResult(models, graph, finished, cuts, tuple(model.georeference for model in built))


def _solved_models(
    database_path: str | PathLike[str], work: Path, graph: ViewGraph, options: MappingOptions, log: StageLog
) -> tuple[ViewGraph, PoseSolution, list[BuiltModel]]:
    """Solve a viewing graph, read again if it has other lenses, and build the models of its components."""
    solution = solve_job_graph(graph, options, log)
    if lenses := lenses_to_read_with(graph, solution, options):
        log.warn(
            "The matches tell of distortion that the database's lenses do not have: the relative poses are estimated"
            " again with it."
        )
        graph = read_job_graph(database_path, options, log, lenses=lenses)
        solution = solve_job_graph(graph, options, log)
    if not solution.registered.any():
        raise MappingError(f"{database_path}: {solution.message}")
    if solution.arrangements and graph.has_inliers and options.solve.method == "epipolar":
        solution = _second_opinion(database_path, work, graph, solution, options, log)
    built = _build(database_path, work, graph, solution, options, log)
    if not built:
        raise MappingError(
            f"{database_path}: {int((solution.component >= 0).sum())} poses were solved, but no three images share"
            " enough points with a sufficient triangulation angle; add overlapping photographs, taken from"
            " different places"
        )
    return graph, solution, built


def _extended(
    database_path: str | PathLike[str],
    work: Path,
    graph: ViewGraph,
    given: "pycolmap.Reconstruction",
    options: MappingOptions,
    log: StageLog,
) -> BuiltModel:
    """Add a database's images to a given model."""
    with (
        log.stage("load"),
        loaded_cache(database_path, work, options.read.min_num_inliers, graph=graph) as (cache, _),
    ):
        pass
    return BuiltModel(*extend_model(cache, given, options, log, _pair_rotations(graph)))


def _build(
    database_path: str | PathLike[str],
    work: Path,
    graph: ViewGraph,
    solution: PoseSolution,
    options: MappingOptions,
    log: StageLog,
) -> list[BuiltModel]:
    """Build models of all components with enough points, and sort them by number of images, the largest first."""
    refined = options.ba_refine_focal_length or options.ba_refine_principal_point or options.ba_refine_extra_params
    shared = shared_cameras(graph) if options.share_cameras and refined and graph.rigs is None else []
    graph, num_separated = with_placed_sensors(graph, solution)
    if num_separated:
        log.warn(
            f"The places of {num_separated} cameras in their rig are not known, and no frame tells them: their images"
            " are placed one by one."
        )
    if scale_is_uncertain(graph, solution):
        log.warn(
            "The known distances between the cameras of the rig do not tell the model's scale: it is arbitrary, and"
            " cameras that see no points of their own may be off by as much."
        )
    without = _false_pairs(graph, solution)
    with log.stage("load"):
        with loaded_cache(database_path, work, options.read.min_num_inliers, shared, without, graph) as (
            cache,
            replaced,
        ):
            components = range(int(solution.component.max(initial=-1)) + 1)
            posed = [posed_model(cache, solution, graph, component) for component in components]
        if replaced:
            log.result(f"{len(replaced) + len(set(replaced.values()))} cameras share calibrations")
    models: list[BuiltModel] = []
    pairs = _pair_rotations(graph)
    for component, of_poses in enumerate(posed):
        others = frozenset(solution.image_ids[~np.isin(solution.component, (-1, component))].tolist())
        reconstruction, result = build_model(cache, of_poses, options, log, others, pairs)
        if reconstruction.num_reg_images() >= 2 and reconstruction.num_points3D() > 0:
            models.append(BuiltModel(reconstruction, result))
        elif len(posed) > 1:
            count = int((solution.component == component).sum())
            log.warn(f"A component of {count} images shares too few points for a model of its own; it is dropped.")
    if len(models) > 1:
        usable = ~np.isin(solution.edge_verdicts, FALSE_PAIRS)
        models = join_models(cache, models, graph, usable, pairs, compared_images(database_path, graph), options, log)
    if models and replaced:
        with (
            log.stage("cameras"),
            loaded_cache(database_path, work, options.read.min_num_inliers, (), without, graph) as (cache, _),
        ):
            models = [
                replace(m, reconstruction=_with_database_cameras(cache, m.reconstruction, replaced, options, log))
                for m in models
            ]
    models = sorted(models, key=lambda model: -model.reconstruction.num_reg_images())
    return _georeferenced(cache, models, graph, options, log)


def _georeferenced(
    cache: "pycolmap.DatabaseCache", models: list[BuiltModel], graph: ViewGraph, options: MappingOptions, log: StageLog
) -> list[BuiltModel]:
    """Move models to the frame of their measured positions, or turn them upright by measured gravity."""
    priors = graph.priors
    if priors is None:
        return models
    with_gravity = options.solve.use_prior_gravity and priors.has_gravity.any()
    if not (priors.has_position.any() or with_gravity):
        return models
    with log.stage("georeference"):
        placed = [
            replace(m, georeference=georeference(cache, m.reconstruction, priors, graph.image_ids, options, log))
            for m in models
        ]
        others = [m.reconstruction for m in placed if m.georeference is None]
        upright = [level_by_gravity(model, priors, graph.image_ids) for model in others] if with_gravity else []
        told = f", {sum(upright)} turned upright by gravity" if with_gravity and others else ""
        log.result(f"{len(placed) - len(others)} of {len(placed)} models georeferenced{told}")
        return placed


def _second_opinion(
    database_path: str | PathLike[str],
    work: Path,
    graph: ViewGraph,
    solution: PoseSolution,
    options: MappingOptions,
    log: StageLog,
) -> PoseSolution:
    """Choose among a solution's arrangements of the images by their missing correspondences."""
    with log.stage("second opinion"):
        # All arrangements are solved with the same reduced effort, so that the comparison is fair.
        rough = replace(solve_options(options), refine_focal_lengths="never")
        found = [
            _point_evidence(database_path, work, graph, solve_view_graph(graph, rough, rotations), options)
            for rotations in solution.arrangements
        ]
        shown = ", ".join(f"{evidence.share_seen:.2f}" for evidence in found)
        log.result(f"share of the points that images should see and do see, per arrangement: {shown}")
        best, settled = best_arrangement(found)
        chosen, in_doubt = solution, None if settled else solution.in_doubt
        if best > 0:
            chosen = solve_view_graph(graph, solve_options(options), solution.arrangements[best])
            for caveat in chosen.caveats:
                log.warn(caveat)
            log.warn(
                "More pairs agree with another arrangement of the images, but in it images do not see the points that"
                f" they should: their share is {found[0].share_seen:.2f}, and {found[best].share_seen:.2f} in the"
                " arrangement that is used."
            )
        elif settled and solution.in_doubt is not None:
            log.warn(
                "The points confirm the arrangement that is used: its images see a share of"
                f" {found[0].share_seen:.2f} of the points that they should see."
            )
        status, message = described(
            chosen.image_verdicts,
            chosen.converged,
            chosen.agreement,
            in_doubt is not None,
            chosen.uncertain is not None,
        )
        return replace(chosen, in_doubt=in_doubt, status=status, message=message)


def _point_evidence(
    database_path: str | PathLike[str], work: Path, graph: ViewGraph, solution: PoseSolution, options: MappingOptions
) -> PointEvidence:
    with loaded_cache(database_path, work, options.read.min_num_inliers, (), _false_pairs(graph, solution), graph) as (
        cache,
        _,
    ):
        return point_evidence(cache, posed_model(cache, solution, graph), options)


def _false_pairs(graph: ViewGraph, solution: PoseSolution) -> list[tuple[int, int]]:
    """Image ids of the pairs that are excluded from triangulation."""
    false = np.isin(solution.edge_verdicts, FALSE_PAIRS)
    return [(int(a), int(b)) for a, b in graph.image_ids[graph.edges[false]]]


def _pair_rotations(graph: ViewGraph) -> PairRotations:
    """Relative rotations of all pairs that have one, whatever their verdict."""
    posed = graph.has_rotation
    matches = np.ones(graph.num_edges) if graph.num_inliers is None else graph.num_inliers.astype(np.float64)
    return PairRotations(graph.image_ids[graph.edges[posed]], graph.cam2_from_cam1_rotations[posed], matches[posed])


def _with_database_cameras(
    cache: "pycolmap.DatabaseCache",
    shared: "pycolmap.Reconstruction",
    replaced: dict[int, int],
    options: MappingOptions,
    log: StageLog,
) -> "pycolmap.Reconstruction":
    """Give a model the database's own cameras; with the shared calibrations unless separate ones fit clearly better."""
    model = with_database_cameras(cache, shared, replaced)
    trial = pycolmap.Reconstruction(model)
    cost_ratio = adjust_once_more(cache, trial, options, rough=True)
    if cost_ratio < SHARED_LENS_COST_RATIO:
        for _ in range(MAX_NUM_ROUNDS):
            if adjust_once_more(cache, trial, options) > CONVERGED_COST_RATIO:
                break
        log.result(f"different lenses: with separate calibrations the cost falls by {1.0 - cost_ratio:.0%}")
        return trial
    log.result(f"one lens: with separate calibrations the cost would fall by only {1.0 - cost_ratio:.1%}")
    model.tear_down()  # removes the cameras, rigs and images of other models
    return model


def _weak_cuts(
    database_path: str | PathLike[str], graph: ViewGraph, models: Sequence[BuiltModel], log: StageLog
) -> tuple[tuple[WeakCut, ...], ...]:
    """Find the weak cuts of each model, and warn of those that missing correspondences contradict."""
    with log.stage("check"):
        compared, pairs = compared_images(database_path, graph), _pair_rotations(graph)
        found = tuple(weak_cuts(model.reconstruction, pairs, compared) for model in models)
        for model, cuts in zip(models, found, strict=True):
            for cut in cuts:
                if cut.contradicted:
                    names = sorted(model.reconstruction.image(i).name for i in cut.images)
                    log.warn(
                        f"{len(names)} images ({names[0]} to {names[-1]}) are linked to the rest of the model by only"
                        f" {cut.num_pairs} of their pairs, and both sides see only a share of {cut.share_seen:.2f} of"
                        f" the points that both should see ({cut.share_seen_elsewhere:.2f} elsewhere). They may show"
                        " another place that looks alike."
                    )
        log.result(f"{sum(map(len, found))} weak links within models")
    return found
