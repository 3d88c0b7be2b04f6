"""Models in COLMAP's text and binary formats, and their points as a PLY file."""

from pathlib import Path

import pycolmap

from colmap_vg.colmap_io.reconstruction import write_model
from colmap_vg.errors import MappingError, OutputError
from colmap_vg.exports.source import Source

_WHITE_SPACE = frozenset(" \t\n\v\f\r")
_END_OF_HEADER, _MAX_HEADER, _BYTES_PER_POINT = b"end_header\n", 1024, 15
"""Of COLMAP's PLY files: three coordinates in single precision and three bytes of colour per point."""


def write_text(source: Source, folder: Path) -> list[str]:
    """Write COLMAP's text format.

    Raises
    ------
    MappingError
        An image name has white space, where COLMAP's reader would cut it off.
    OutputError
        A file cannot be written.
    """
    for image in source.images():
        if _WHITE_SPACE.intersection(image.name):
            raise MappingError(
                f"COLMAP's text format cannot hold the image name {image.name!r}, which has white space: export binary"
            )
    model = source.reconstruction
    try:
        model.write_text(folder)
        written = pycolmap.Reconstruction(folder)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise OutputError(
            f"COLMAP's text files cannot be written in full ({error}): free disk space or choose another output_path"
        ) from error
    # COLMAP does not check whether its files could be written.
    if written.num_reg_images() != model.num_reg_images() or written.num_points3D() != model.num_points3D():
        raise OutputError(f"the model in {folder} is incomplete: free disk space or choose another output_path")
    return []


def write_binary(source: Source, folder: Path) -> list[str]:
    """Write COLMAP's binary format, see `write_model`."""
    write_model(source.reconstruction, folder)
    return []


def write_ply(source: Source, path: Path) -> list[str]:
    """Write the points as a binary PLY file: coordinates in single precision, world frame, and colours.

    Raises
    ------
    MappingError
        The model has no points.
    OutputError
        The file cannot be written.
    """
    num_points = source.reconstruction.num_points3D()
    if num_points == 0:
        raise MappingError(f"{source.folder}: the model has no points")
    try:
        source.reconstruction.export_PLY(path)
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"cannot write {path} ({error}); choose another output_path") from error
    with path.open("rb") as file:  # a full disk is no error to COLMAP
        header = file.read(_MAX_HEADER).partition(_END_OF_HEADER)[0]
    if path.stat().st_size != len(header) + len(_END_OF_HEADER) + _BYTES_PER_POINT * num_points:
        raise OutputError(f"{path} is incomplete: free disk space or choose another output_path")
    return []
