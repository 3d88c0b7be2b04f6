"""Export a model: from a folder of a model or a job to a file or folder in another program's format."""

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import get_args

from colmap_vg.colmap_io.quiet import quiet_colmap
from colmap_vg.errors import OptionError
from colmap_vg.exports.bundler import write_bundler
from colmap_vg.exports.colmap_files import write_binary, write_ply, write_text
from colmap_vg.exports.nerfstudio import write_nerfstudio
from colmap_vg.exports.pose_graph import write_g2o
from colmap_vg.exports.publishing import check_output, published
from colmap_vg.exports.source import Source, find_source
from colmap_vg.exports.splat import write_splat
from colmap_vg.exports.trajectory import write_tum
from colmap_vg.jobs.summary import plain
from colmap_vg.options import ExportFormat

_FILES: dict[str, Callable[[Source, Path], list[str]]] = {"ply": write_ply, "tum": write_tum, "g2o": write_g2o}
_FOLDERS: dict[str, Callable[[Source, Path], list[str]]] = {
    "text": write_text,
    "binary": write_binary,
    "bundler": write_bundler,
}


@dataclass(frozen=True)
class Export:
    """What was exported.

    Attributes
    ----------
    path : Path
        The file or folder.
    num_images, num_points : int
        Images with a pose, and points, of the model.
    notes : tuple of str
        What a reader of the format should know.
    """

    path: Path
    num_images: int
    num_points: int
    notes: tuple[str, ...]


def export_model(
    input_path: str | PathLike[str],
    output_path: str | PathLike[str],
    format: ExportFormat,
    *,
    image_path: str | PathLike[str] | None = None,
    model: int | None = None,
    max_image_size: int | None = None,
    overwrite: bool = False,
) -> Export:
    """Write a model in the format of another program. The model and the photographs are not changed.

    Parameters
    ----------
    input_path : path
        Folder of a COLMAP model, or of a finished job.
    output_path : path
        A file for ``ply``, ``tum`` and ``g2o``, a folder for the other formats. It appears when it is complete.
    format : str
        ``text``, ``binary``, ``ply``, ``nerfstudio``, ``bundler``, ``tum``, ``g2o`` or ``splat``.
    image_path : path, optional
        Folder of the photographs, for ``nerfstudio`` and ``splat``. Default: that of the job.
    model : int, optional
        Which of the job's models. Default: 0.
    max_image_size : int, optional
        Longer side of the images of ``splat``, pixels.
    overwrite : bool
        Whether an earlier export is replaced.

    Returns
    -------
    Export

    Raises
    ------
    OptionError
        The format is unknown, or an option does not fit it.
    DataFileError
        The model cannot be read.
    ImageFolderError
        The photographs are not known, missing, or not those of the model.
    MappingError
        The format cannot hold the model.
    OutputError
        The output exists or cannot be written.
    """
    if format not in get_args(ExportFormat):
        raise OptionError(f"format must be one of {', '.join(get_args(ExportFormat))}, found {format!r}")
    if max_image_size is not None and (format != "splat" or max_image_size < 1):
        raise OptionError("max_image_size is a positive number of pixels, for the format splat only")
    output, is_folder = Path(output_path), format not in _FILES
    with quiet_colmap():
        source = find_source(Path(input_path), None if image_path is None else Path(image_path), model)
        inputs = (source.folder, *([source.image_path] if source.image_path is not None else []))
        check_output(output, is_folder, overwrite, inputs)
        record: dict[str, object] = {
            "format": format,
            "model": plain(source.folder),
            "image_path": plain(source.image_path),
            "max_image_size": max_image_size,
        }
        with published(output, is_folder, record) as staged:
            if format == "nerfstudio":
                notes = write_nerfstudio(source, staged, output)
            elif format == "splat":
                notes = write_splat(source, staged, max_image_size)
            else:
                notes = {**_FILES, **_FOLDERS}[format](source, staged)
            record["notes"] = notes
    return Export(output, len(source.images()), source.reconstruction.num_points3D(), tuple(notes))
