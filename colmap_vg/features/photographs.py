"""Which files of a folder are photographs that can be used, and why the others cannot.

COLMAP decodes what it can of a damaged file and goes on: half of a truncated JPEG becomes a grey half image with wrong
features, without a word. So the structure of JPEG and PNG files is checked before anything is extracted.
"""

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import pycolmap

from colmap_vg.errors import ImageFolderError
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

_STANDALONE = frozenset([0x01, *range(0xD0, 0xD8)])
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_AFTER_SCAN_DATA = re.compile(rb"\xff+[\x01-\xcf\xd8-\xfe]")


@dataclass(frozen=True)
class Photograph:
    """A file that can be used.

    Attributes
    ----------
    name : str
        Path relative to the image folder, with forward slashes, as COLMAP names images.
    width, height : int
        Pixels, as stored (before any EXIF orientation).
    """

    name: str
    width: int
    height: int


@dataclass(frozen=True)
class SkippedFile:
    """A file that is left out, with the reason in words."""

    name: str
    reason: str


class _DamagedFileError(Exception):
    """The file's structure is broken; the message is the reason for the user."""


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
        raise ImageFolderError(f"no such image folder: {folder}; check --image_path")
    if not folder.is_dir():
        raise ImageFolderError(f"{folder} is a file; --image_path must be the folder that holds the photographs")
    photographs: list[Photograph] = []
    skipped: list[SkippedFile] = []
    for name in sorted(set(names)) if names is not None else _visible_files(folder, exclude):
        found = _check(folder / name, name)
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


def split_unmasked(
    photographs: Sequence[Photograph], mask_path: str | PathLike[str]
) -> tuple[list[Photograph], list[SkippedFile]]:
    """Leave out photographs without a usable mask, as COLMAP does, but say so.

    The mask of ``folder/a.jpg`` is ``folder/a.jpg.png``, or ``folder/a.png``, and has the photograph's size.
    """
    masks = Path(mask_path)
    if not masks.is_dir():
        raise ImageFolderError(f"no such mask folder: {masks}; check --mask_path")
    kept, skipped = [], []
    for photograph in photographs:
        candidates = (masks / f"{photograph.name}.png", (masks / photograph.name).with_suffix(".png"))
        mask = next((candidate for candidate in candidates if candidate.is_file()), None)
        if mask is None:
            skipped.append(SkippedFile(photograph.name, f"it has no mask {candidates[0]}"))
            continue
        checked = _check(mask, str(mask))
        if isinstance(checked, SkippedFile):
            skipped.append(SkippedFile(photograph.name, f"of its mask {mask}: {checked.reason}"))
        elif (checked.width, checked.height) != (photograph.width, photograph.height):
            sizes = f"{checked.width} x {checked.height} pixels, not {photograph.width} x {photograph.height}"
            skipped.append(SkippedFile(photograph.name, f"its mask {mask} is {sizes}"))
        else:
            kept.append(photograph)
    return kept, skipped


def _visible_files(folder: Path, exclude: Iterable[Path]) -> list[str]:
    excluded = {path.resolve() for path in exclude}
    names = []
    for path in folder.rglob("*"):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if not hidden and path.is_file() and not excluded.intersection(path.resolve().parents):
            names.append(relative.as_posix())
    return sorted(names)


def _check(path: Path, name: str) -> Photograph | SkippedFile:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return SkippedFile(name, "there is no such file")
    except OSError as error:
        return SkippedFile(name, f"it cannot be read ({error.strerror})")
    try:
        width, height = _size(path, data)
    except _DamagedFileError as error:
        return SkippedFile(name, str(error))
    if min(width, height) < MIN_SIDE:
        return SkippedFile(name, f"it has only {width} x {height} pixels")
    return Photograph(name, width, height)


def _size(path: Path, data: bytes) -> tuple[int, int]:
    if not data:
        raise _DamagedFileError("the file is empty")
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_size(data)
    if path.suffix.lower() not in SUFFIXES.split():
        raise _DamagedFileError("it is no photograph")
    bitmap = pycolmap.Bitmap.read(path, False)
    if bitmap is None:
        raise _DamagedFileError("it cannot be decoded as an image")
    return bitmap.width, bitmap.height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Walk the markers of a JPEG file to its end (ITU-T T.81, annex B), and read the size from the frame header."""
    size, position, scans = None, 2, 0
    while True:
        if position + 2 > len(data):
            raise _DamagedFileError("the JPEG file is truncated")
        if data[position] != 0xFF:
            raise _DamagedFileError(f"the JPEG file is corrupt at byte {position}")
        marker = data[position + 1]
        position += 1 if marker == 0xFF else 2
        if marker == 0xD9:
            break
        if marker == 0xFF or marker in _STANDALONE:
            continue
        length = int.from_bytes(data[position : position + 2], "big")
        if length < 2 or marker < 0xC0:
            raise _DamagedFileError(f"the JPEG file is corrupt at byte {position}")
        if marker in _START_OF_FRAME and position + 7 <= len(data):
            height, width = struct.unpack(">HH", data[position + 3 : position + 7])
            size = (width, height)
        position += length
        if marker == 0xDA:
            scans += 1
            following = _AFTER_SCAN_DATA.search(data, position)
            if following is None:
                raise _DamagedFileError("the JPEG file is truncated")
            position = following.end() - 2
    if size is None or not scans:
        raise _DamagedFileError("the JPEG file holds no image")
    return size


def _png_size(data: bytes) -> tuple[int, int]:
    """Walk the chunks of a PNG file with their checksums (ISO/IEC 15948, clause 5)."""
    position, size = 8, None
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise _DamagedFileError(f"the PNG file is corrupt: wrong checksum at byte {position}")
        if kind == b"IHDR":
            size = struct.unpack(">II", data[position + 8 : position + 16])
        if kind == b"IEND" and size is not None:
            return size[0], size[1]
        position = end
    raise _DamagedFileError("the PNG file is truncated")
