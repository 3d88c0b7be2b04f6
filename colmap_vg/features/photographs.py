"""Which files of a folder are photographs that can be used, and why the others cannot.

Files that COLMAP cannot read as they are, and OpenCV can, are marked to be copied (`staging`).
"""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from colmap_vg.errors import ImageFolderError
from colmap_vg.features.image_files import DamagedFileError, jpeg_size, png_header
from colmap_vg.features.pixels import decoded
from colmap_vg.options import CameraMode

MIN_IMAGES = 3
"""Images; two views have no redundancy that could tell a right model from a wrong one."""

MIN_SIDE = 32
"""Pixels; SIFT finds nothing that could be matched in a smaller image."""

SUFFIXES = (
    ".jpg .jpeg .jpe .png .tif .tiff .bmp .dib .webp .ppm .pgm .pnm .jp2 .j2k .heic .heif .avif .tga .gif .exr .hdr "
    ".dng .cr2 .cr3 .nef .arw .orf .rw2 .raf"
)
"""File name endings that promise an image; a file with another one and unknown content is no photograph."""

_HEIF_SUFFIXES = (".heic", ".heif")
_FULL_SIXTEEN_BITS = 1 << 15


def leads_out(name: str) -> bool:
    """Whether an image's name, relative to the folder of photographs, leads out of it.

    >>> leads_out("a/b.jpg"), leads_out("../b.jpg"), leads_out("/b.jpg")
    (False, True, True)
    """
    path = PurePosixPath(name)
    return path.is_absolute() or ".." in path.parts


@dataclass(frozen=True)
class Photograph:
    """A file that can be used.

    Attributes
    ----------
    name : str
        Path relative to the image folder, with forward slashes, as COLMAP names images.
    width, height : int
        Pixels, as stored (before any EXIF orientation).
    copied : bool
        COLMAP cannot read the file as it is, and OpenCV can.
    mask : Path or None
        Its mask, where one is used.
    """

    name: str
    width: int
    height: int
    copied: bool = False
    mask: Path | None = None


@dataclass(frozen=True)
class SkippedFile:
    """A file that is left out, with the reason in words."""

    name: str
    reason: str


def find_photographs(
    image_path: str | PathLike[str],
    names: Sequence[str] | None = None,
    exclude: Iterable[Path] = (),
) -> tuple[list[Photograph], list[SkippedFile]]:
    """List the photographs under a folder, recursively, and the files that cannot be used.

    Parameters
    ----------
    image_path : path
        Folder of photographs.
    names : sequence of str, optional
        Names relative to the folder to which the search is confined; default: every file that is not hidden.
    exclude : iterable of Path
        Folders that are not searched, for instance masks kept beside the photographs.

    Returns
    -------
    photographs : list of Photograph
        By name.
    skipped : list of SkippedFile

    Raises
    ------
    ImageFolderError
        The folder is missing, is no folder, or cannot be read.
    """
    folder = Path(image_path)
    if not folder.exists():
        raise ImageFolderError(f"no such image folder: {folder}; check image_path")
    if not folder.is_dir():
        raise ImageFolderError(f"{folder} is a file; image_path must be the folder that holds the photographs")
    photographs: list[Photograph] = []
    skipped: list[SkippedFile] = []
    for name in sorted(set(names)) if names is not None else _visible_files(folder, exclude):
        found = check_photograph(folder / name, name)
        if isinstance(found, Photograph):
            photographs.append(found)
        else:
            skipped.append(found)
    return photographs, skipped


def split_odd_sizes(
    photographs: Sequence[Photograph], camera_mode: CameraMode, one_calibration: bool
) -> tuple[list[Photograph], list[SkippedFile]]:
    """Leave out photographs whose size contradicts the camera that they would have to share.

    Parameters
    ----------
    photographs : sequence of Photograph
    camera_mode : str
        ``single`` shares one camera over all images, ``per_folder`` one within each folder.
    one_calibration : bool
        Camera parameters are given: they hold for one image size only, whatever the mode.

    Returns
    -------
    kept : list of Photograph
        Those of the most frequent size (of equally frequent ones, the largest).
    skipped : list of SkippedFile
    """
    if camera_mode in ("auto", "per_image") and not one_calibration:
        return list(photographs), []
    by_folder = camera_mode == "per_folder" and not one_calibration
    groups: dict[str, list[Photograph]] = {}
    for photograph in photographs:
        groups.setdefault(str(Path(photograph.name).parent) if by_folder else "", []).append(photograph)
    expected = {}
    for group, members in groups.items():
        sizes = Counter((member.width, member.height) for member in members)
        expected[group] = max(sizes, key=lambda size: (sizes[size], size[0] * size[1], size))
    kept, skipped = [], []
    for photograph in photographs:
        width, height = expected[str(Path(photograph.name).parent) if by_folder else ""]
        if (photograph.width, photograph.height) == (width, height):
            kept.append(photograph)
            continue
        found = f"it is {photograph.width} x {photograph.height} pixels, the others are {width} x {height}"
        why = "the given camera parameters hold for one size" if one_calibration else "they would share one camera"
        skipped.append(SkippedFile(photograph.name, f"{found}, and {why}"))
    return kept, skipped


def _visible_files(folder: Path, exclude: Iterable[Path]) -> list[str]:
    excluded = {path.resolve() for path in exclude}
    names, entered = [], set[Path]()
    # A folder that is reached twice, through a link, counts once: its photographs are the same.
    for at, folders, files in os.walk(folder, followlinks=True):
        real = Path(at).resolve()
        if real in entered or real in excluded or excluded.intersection(real.parents):
            folders.clear()
            continue
        entered.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = [Path(at) / name for name in files if not name.startswith(".")]
        names += [path.relative_to(folder).as_posix() for path in paths if path.is_file()]
    return sorted(names)


def check_photograph(path: Path, name: str) -> Photograph | SkippedFile:
    """A file as a photograph of this name, or why it cannot be one."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return SkippedFile(name, "there is no such file")
    except OSError as error:
        return SkippedFile(name, f"it cannot be read ({error.strerror})")
    try:
        photograph = _measured(path, name, data)
    except DamagedFileError as error:
        return SkippedFile(name, str(error))
    if min(photograph.width, photograph.height) < MIN_SIDE:
        return SkippedFile(name, f"it has only {photograph.width} x {photograph.height} pixels")
    return photograph


def _measured(path: Path, name: str, data: bytes) -> Photograph:
    if not data:
        raise DamagedFileError("the file is empty")
    if data.startswith(b"\xff\xd8"):
        return Photograph(name, *jpeg_size(data))
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        width, height, bits = png_header(data)
        return Photograph(name, width, height, bits == 16 and _is_dark(path))
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES.split():
        raise DamagedFileError("it is no photograph")
    bitmap = pycolmap.Bitmap.read(path, False)
    if bitmap is not None:
        return Photograph(name, bitmap.width, bitmap.height, suffix in (".tif", ".tiff") and _is_dark(path))
    pixels = decoded(data)
    if pixels is None:
        heif = "it is a HEIF file, which neither COLMAP nor OpenCV decodes: convert it to JPEG, as pillow-heif does"
        raise DamagedFileError(heif if suffix in _HEIF_SUFFIXES else "it cannot be decoded as an image")
    return Photograph(name, pixels.shape[1], pixels.shape[0], copied=True)


def _is_dark(path: Path) -> bool:
    """Whether the pixels have sixteen bits and leave the last of them unused, as data of twelve bits do."""
    pixels = decoded(path.read_bytes())
    return pixels is not None and pixels.dtype == np.uint16 and 0 < int(pixels.max()) < _FULL_SIXTEEN_BITS
