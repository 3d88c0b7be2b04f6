"""Convert photographs and masks that COLMAP cannot read to PNG copies.

Formats that only OpenCV decodes, 16-bit files that use fewer bits, and masks under other names are copied as PNG files
to a separate folder, with their EXIF data and under the photographs' names; the other files become links in it. So
COLMAP reads one folder, whatever the formats, and keypoints refer to the pixels of the original files.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from shutil import rmtree
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import ImageFolderError, OutputError
from colmap_vg.features.photographs import Photograph
from colmap_vg.features.pixels import stretched
from colmap_vg.options import FeatureOptions

_AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
_MASKED_BELOW = 128
"""Grey value (0 to 255) below which a pixel of a JPEG mask is masked: compression changes black slightly."""


@contextmanager
def readable_folder(
    image_path: str | PathLike[str],
    photographs: Sequence[Photograph],
    options: FeatureOptions,
    folder: Path,
) -> Iterator[tuple[Path, FeatureOptions]]:
    """Make temporary copies of photographs and masks that COLMAP cannot read.

    Parameters
    ----------
    image_path : path
    photographs : sequence of Photograph
    options : FeatureOptions
    folder : Path
        Folder for the copies, created if they are needed and removed at the end.

    Yields
    ------
    Path
        Folder of images that COLMAP can read; `image_path` if no copies are needed.
    FeatureOptions
        With a folder of masks that COLMAP can read.

    Raises
    ------
    OutputError
        Copies cannot be written.
    """
    source, masks = Path(image_path), options.mask_path
    rmtree(folder, ignore_errors=True)
    try:
        if any(photograph.copied for photograph in photographs):
            for photograph in photographs:
                target = _made(folder / "images", photograph.name)
                if photograph.copied:
                    _copy(source / photograph.name, target)
                else:
                    target.symlink_to((source / photograph.name).resolve())
            source = folder / "images"
        if masks is not None and any(_named_otherwise(photograph, Path(masks)) for photograph in photographs):
            for photograph in photographs:
                target = _made(folder / "masks", f"{photograph.name}.png")
                _write_png(target, _mask(photograph))
            masks = folder / "masks"
        yield source, replace(options, mask_path=masks)
    except OSError as error:
        raise OutputError(f"cannot write copies of photographs to {folder}: {error.strerror}") from error
    finally:
        rmtree(folder, ignore_errors=True)


def _named_otherwise(photograph: Photograph, masks: Path) -> bool:
    """Whether COLMAP would not find the photograph's mask, or would skip the photograph because it has none."""
    return photograph.mask not in (masks / f"{photograph.name}.png", (masks / photograph.name).with_suffix(".png"))


def _made(folder: Path, name: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _copy(source: Path, target: Path) -> None:
    """Copy a photograph as a PNG file with its metadata, stretched to the full range of its bits."""
    pixels, kinds, metadata = cv2.imreadWithMetadata(str(source), _AS_STORED)
    if pixels is None:
        raise ImageFolderError(f"{source} can no longer be decoded")
    _write_png(target, stretched(pixels), kinds, metadata)


def _mask(photograph: Photograph) -> NDArray[np.uint8]:
    """Read a photograph's mask as 255 where features are extracted and 0 elsewhere; all 255 without a mask."""
    if photograph.mask is None:
        return np.full((photograph.height, photograph.width), 255, dtype=np.uint8)
    read = cv2.imread(str(photograph.mask), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if read is None:
        raise ImageFolderError(f"the mask {photograph.mask} can no longer be decoded")
    lossless = photograph.mask.suffix.lower() == ".png"
    return np.where(read >= (1 if lossless else _MASKED_BELOW), 255, 0).astype(np.uint8)


def _write_png(
    target: Path, pixels: NDArray[Any], metadata_kinds: Sequence[int] = (), metadata: Sequence[NDArray[Any]] = ()
) -> None:
    """Write a PNG file; the ending of its name may be that of another format."""
    _, data = cv2.imencodeWithMetadata(".png", pixels, metadata_kinds, metadata)
    target.write_bytes(data.tobytes())
