"""What the explorer reads of a finished job: its viewing graph, lists of pairs, options and points."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.pair_lists import listed_edges
from colmap_vg.colmap_io.tables import read_tables
from colmap_vg.errors import DataFileError
from colmap_vg.events import StageLog
from colmap_vg.jobs.graph import read_job_graph
from colmap_vg.jobs.image_folder import DATABASE_NAME
from colmap_vg.jobs.recorded_options import recorded_options
from colmap_vg.jobs.summary import given_path, read_summary
from colmap_vg.options import MappingOptions
from colmap_vg.report.models import MAX_POINTS, model_view, read_model
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FinishedJob:
    """A finished job as the explorer needs it.

    Attributes
    ----------
    output_path, database_path : Path
    image_path : Path or None
        Folder of the photographs, if it is known.
    options : MappingOptions
        Those of the job, without its lists of pairs.
    graph : ViewGraph
        Read with these options: no pair is excluded or trusted.
    excluded, trusted : (m,) bool array
        Pairs on the job's lists.
    sizes : (n, 2) int64 array
        Width and height of each image, pixels.
    centers : (n, 3) array
        Projection centres of the job's largest model, with the third axis up; NaN for images outside of it.
    points : (k, 3) float32 array
        Points of that model in the same frame, evenly subsampled, without far ones.
    colors : (k, 3) uint8 array
    """

    output_path: Path
    database_path: Path
    image_path: Path | None
    options: MappingOptions
    graph: ViewGraph
    excluded: BoolArray
    trusted: BoolArray
    sizes: IntArray
    centers: Array
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]


def read_finished_job(
    output_path: Path, image_path: Path | None = None, database_path: Path | None = None
) -> FinishedJob:
    """Read a finished job.

    Parameters
    ----------
    output_path : Path
    image_path, database_path : Path, optional
        By default those that the job had. Neither is changed.

    Raises
    ------
    ColmapVgError
        The summary, the model or the database is missing or damaged.
    """
    summary = read_summary(output_path)
    database_path = database_path or given_path(summary, "database_path", output_path / DATABASE_NAME)
    if database_path is None:
        raise DataFileError(f"the database of the job in {output_path} is gone: say where it is (database_path)")
    options = recorded_options(summary, output_path)
    lists = options.read.excluded_pairs_path, options.read.trusted_pairs_path
    options = replace(options, read=replace(options.read, excluded_pairs_path=None, trusted_pairs_path=None))
    graph = read_job_graph(database_path, options, StageLog())
    excluded, trusted = (listed_edges(path, graph.image_names, graph.edges) for path in lists)
    tables = read_tables(database_path)
    sizes = np.array([[camera.width, camera.height] for camera in tables.cameras], dtype=np.int64)
    row_of = {name: row for row, name in enumerate(graph.image_names)}
    view = model_view("0", read_model(output_path / "0"), row_of, MAX_POINTS)
    centers = np.full((graph.num_images, 3), np.nan)
    centers[view.images] = view.centers
    return FinishedJob(
        output_path,
        database_path,
        image_path or given_path(summary, "image_path", output_path / "images"),
        options,
        graph,
        excluded,
        trusted & ~excluded,
        sizes[tables.camera_idx],
        centers,
        view.points,
        view.colors,
    )
