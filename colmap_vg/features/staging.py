"""Photographs and masks in a form that COLMAP reads, where it cannot read them as they are.

Formats that OpenCV alone decodes, data of few bits in files of sixteen, and masks under other names become PNG copies
in a folder of their own, with their EXIF data and under the photographs' names; the others are links in it. So there is
one folder for COLMAP, whatever the photographs came as, and keypoints are in the pixels of the files as they are.
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
"""Of 255; black in a JPEG file is not quite."""


@contextmanager
def readable_folder(
    image_path: str | PathLike[str],
    photographs: Sequence[Photograph],
    options: FeatureOptions,
    folder: Path,
) -> Iterator[tuple[Path, FeatureOptions]]:
    """Folder of images and options whose masks COLMAP reads; copies are gone afterwards.

    Parameters
    ----------
    image_path : path
    photographs : sequence of Photograph
    options : FeatureOptions
    folder : Path
        Made where copies are needed.

    Yields
    ------
    Path
        `image_path` where COLMAP reads all photographs as they are.
    FeatureOptions

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
    """Whether COLMAP would not find the mask, or would leave the photograph out for want of one."""
    return photograph.mask not in (masks / f"{photograph.name}.png", (masks / photograph.name).with_suffix(".png"))


def _made(folder: Path, name: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _copy(source: Path, target: Path) -> None:
    """Copy as PNG with the metadata, in as many bits as the data have."""
    pixels, kinds, metadata = cv2.imreadWithMetadata(str(source), _AS_STORED)
    if pixels is None:
        raise ImageFolderError(f"{source} can no longer be decoded")
    _write_png(target, stretched(pixels), kinds, metadata)


def _mask(photograph: Photograph) -> NDArray[np.uint8]:
    """White where features count."""
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
    """Write a PNG file under a name whose ending may say another format."""
    _, data = cv2.imencodeWithMetadata(".png", pixels, metadata_kinds, metadata)
    target.write_bytes(data.tobytes())
