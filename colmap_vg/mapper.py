"""From a COLMAP database to models: read the viewing graph, solve it, build the model, write it whole or not at all."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.colmap_io.database import check_database
from colmap_vg.colmap_io.read import read_with_caveats
from colmap_vg.colmap_io.reconstruction import loaded_cache, reconstruction_from_solution
from colmap_vg.errors import MappingError
from colmap_vg.mapping.build import BuildResult, build_model, extract_colors
from colmap_vg.options import MappingOptions
from colmap_vg.output_folder import prepare_output, publish_models, refuse_models
from colmap_vg.solution import PoseSolution
from colmap_vg.solve import solve_view_graph
from colmap_vg.stages import StageEvent, StageLog
from colmap_vg.verdicts import ImageVerdict
from colmap_vg.view_graph import ViewGraph


@dataclass(frozen=True, eq=False)
class MappingResult:
    """What a mapping job found.

    Attributes
    ----------
    models : dict of int to pycolmap.Reconstruction
        As written, the largest first.
    graph : ViewGraph
    solution : PoseSolution
        With the image verdicts of the finished model.
    """

    models: dict[int, "pycolmap.Reconstruction"]
    graph: ViewGraph
    solution: PoseSolution


def view_graph_mapping(
    database_path: str | PathLike[str],
    image_path: str | PathLike[str] | None,
    output_path: str | PathLike[str],
    options: MappingOptions | None = None,
    on_event: Callable[[StageEvent], None] | None = None,
) -> dict[int, "pycolmap.Reconstruction"]:
    """Make models from a database of verified matches, in place of ``pycolmap.global_mapping``.

    Parameters
    ----------
    database_path : path
        Never modified.
    image_path : path or None
        Folder of the photographs, for the colours of points; without it they stay black.
    output_path : path
        Models are written to ``output_path/0``, ``output_path/1``, ...; they appear whole or not at all.
    options : MappingOptions, optional
    on_event : callable, optional
        Called with a `StageEvent` whenever a stage starts, gets on, ends, or has something to warn of.

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
    """
    return map_database(database_path, image_path, output_path, options or MappingOptions(), StageLog(on_event)).models


def map_database(
    database_path: str | PathLike[str],
    image_path: str | PathLike[str] | None,
    output_path: str | PathLike[str],
    options: MappingOptions,
    log: StageLog,
) -> MappingResult:
    """As :func:`view_graph_mapping`, with the stages in the caller's log, the graph and the verdicts.

    Parameters
    ----------
    database_path, image_path, output_path, options
        As for :func:`view_graph_mapping`.
    log : StageLog

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
    work = prepare_output(output_path, options.overwrite)
    with log.stage("view graph"):
        read = replace(options.read, num_threads=options.num_threads, random_seed=options.random_seed)
        graph, caveats = read_with_caveats(database_path, read)
        for caveat in caveats:
            log.warn(caveat)
        log.result(f"{graph.num_images} images, {graph.num_edges} pairs, {int(graph.has_rotation.sum())} usable")
    with log.stage("solve"):
        solve = replace(options.solve, random_seed=options.random_seed)
        if not options.ba_refine_focal_length:
            solve = replace(solve, refine_focal_lengths="never")
        solution = solve_view_graph(graph, solve)
        log.result(solution.message)
    if not solution.registered.any():
        raise MappingError(f"{database_path}: {solution.message}")
    with log.stage("load"), loaded_cache(database_path, work, options.read.min_num_inliers) as cache:
        reconstruction = reconstruction_from_solution(cache, solution, graph)
    result = build_model(cache, reconstruction, options, log)
    if reconstruction.num_reg_images() < 2 or reconstruction.num_points3D() == 0:
        raise MappingError(
            f"{database_path}: {int(solution.registered.sum())} poses were solved, but no three images share points at"
            " an angle that could fix them; add overlapping photographs, taken from different places"
        )
    with log.stage("write"):
        reconstruction.normalize()
        if options.extract_colors:
            extract_colors(reconstruction, image_path, log)
        staged = work / "0"
        staged.mkdir(exist_ok=True)
        reconstruction.write(staged)
        publish_models([staged], output_path)
        log.result(str(Path(output_path) / "0"))
    return MappingResult({0: reconstruction}, graph, _with_final_verdicts(solution, result))


def _with_final_verdicts(solution: PoseSolution, result: BuildResult) -> PoseSolution:
    """The solution with the verdicts of images that were added or removed while the model was built."""
    words = solution.image_verdicts.astype(object)
    words[np.isin(solution.image_ids, sorted(result.added))] = ImageVerdict.REGISTERED
    words[np.isin(solution.image_ids, sorted(result.removed))] = ImageVerdict.FEW_OBSERVATIONS
    return replace(solution, image_verdicts=words.astype(str), registered=words == ImageVerdict.REGISTERED)
