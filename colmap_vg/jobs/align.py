"""Align a model to known positions, as a job: a new folder with the aligned model and what it tells."""

import json
from os import PathLike

import pycolmap

from colmap_vg.colmap_io.known_positions import read_positions, read_survey_points
from colmap_vg.colmap_io.reconstruction import write_model
from colmap_vg.errors import DataFileError
from colmap_vg.events import StageLog
from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.jobs.output_folder import output_lock, publish_models, refuse_models, stage_models, work_folder
from colmap_vg.jobs.summary import plain
from colmap_vg.mapping.alignment import align_to_points, align_to_positions
from colmap_vg.mapping.georeference import Georeference

FILE_NAME = "alignment.json"


def align(
    input_path: str | PathLike[str],
    output_path: str | PathLike[str],
    *,
    positions_path: str | PathLike[str] | None = None,
    points_path: str | PathLike[str] | None = None,
    by_gps: bool = False,
    overwrite: bool = False,
    log: StageLog | None = None,
) -> Georeference:
    """Write a copy of a model that is aligned to known positions of its cameras or of survey points.

    Parameters
    ----------
    input_path : path
        Folder of a COLMAP model; it is not changed.
    output_path : path
        The model is written to ``output_path/0``, and what the positions tell to ``output_path/alignment.json``.
    positions_path, points_path : path, optional
        One of them, see `read_positions` and `read_survey_points`.
    by_gps : bool
        Whether positions are latitude, longitude and ellipsoidal height (WGS84).
    overwrite : bool
    log : StageLog, optional

    Returns
    -------
    Georeference

    Raises
    ------
    DataFileError
        A file cannot be read, or not exactly one file of positions is given.
    MappingError
        The positions do not align the model.
    OutputError
        The output cannot be written, or holds a model.
    """
    log = log or StageLog()
    if (positions_path is None) == (points_path is None):
        raise DataFileError("align needs either ref_images_path or ref_points_path")
    refuse_models(output_path, overwrite)
    try:
        model = pycolmap.Reconstruction(input_path)
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        raise DataFileError(f"{input_path}: is no COLMAP model that can be read ({error})") from error
    with output_lock(output_path), work_folder(output_path, overwrite) as work:
        if positions_path is not None:
            found = align_to_positions(model, read_positions(positions_path), by_gps, log)
        else:
            found = align_to_points(model, read_survey_points(points_path or ""), by_gps, log)
        (staged,) = stage_models(work, 1)
        write_model(model, staged)
        (folder,) = publish_models([staged], output_path)
        content = {"input_path": str(input_path), "warnings": list(log.warnings), "georeference": plain(found)}
        atomic_write(folder.parent / FILE_NAME, json.dumps(content, indent=1))
    return found
