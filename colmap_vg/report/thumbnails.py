"""Small copies of photographs as data URIs."""

from base64 import b64encode
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_vg.features.photographs import leads_out

MAX_THUMBNAILS, MANY = 1000, 200
"""Maximum number of thumbnails, and their number from which they are smaller."""
SIDE, SMALL_SIDE, PREVIEW_SIDE = 96, 64, 320
"""Longer side of a thumbnail, of one among many, and of an image of a pair with matches, pixels."""
QUALITY = 70


def thumbnails(folder: Path, names: Sequence[str], sides: Sequence[int]) -> list[str]:
    """Make small copies of photographs as they are stored, before any EXIF orientation, as COLMAP reads them.

    Parameters
    ----------
    folder : Path
    names : sequence of str
        Names of the photographs in the folder.
    sides : sequence of int
        Longer side of each copy, pixels.

    Returns
    -------
    list of str
        JPEG data URIs; empty where a photograph is missing or cannot be read.
    """
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda name, side: _thumbnail(folder, name, side), names, sides))


def photograph(folder: Path, name: str, side: int) -> NDArray[np.uint8] | None:
    """Read a photograph as it is stored, at the smallest size that is decoded at once and not below `side`.

    Parameters
    ----------
    folder : Path
        Folder of the photographs.
    name : str
        As in the database: one that leads out of the folder is not read.
    side : int
        Longer side, pixels.

    Returns
    -------
    (h, w, 3) uint8 array or None
        Red, green and blue; None where it is missing, cannot be read, or lies outside of the folder.
    """
    try:
        # Links in the folder are the user's, and may lead anywhere; names are the database's.
        if leads_out(name):
            return None
        pixels = _decoded(np.frombuffer((folder / name).read_bytes(), dtype=np.uint8), side)
    except (OSError, ValueError, cv2.error):  # a name with a zero byte is a ValueError
        return None
    return None if pixels is None else np.ascontiguousarray(pixels[:, :, ::-1])


def _thumbnail(folder: Path, name: str, side: int) -> str:
    pixels = photograph(folder, name, side)
    if pixels is None:
        return ""
    try:
        scale = min(side / max(pixels.shape[:2]), 1.0)
        size = [max(round(scale * length), 1) for length in pixels.shape[1::-1]]
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        written, encoded = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    except cv2.error:
        return ""
    return f"data:image/jpeg;base64,{b64encode(encoded.tobytes()).decode('ascii')}" if written else ""


def _decoded(data: NDArray[np.uint8], side: int) -> NDArray[Any] | None:
    """Pixels of the smallest size that OpenCV decodes directly and that is not below `side`; None if it cannot."""
    pixels = None
    for flag in (cv2.IMREAD_REDUCED_COLOR_8, cv2.IMREAD_REDUCED_COLOR_4, cv2.IMREAD_COLOR):
        pixels = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None or max(pixels.shape[:2]) >= side:
            break
    return pixels
