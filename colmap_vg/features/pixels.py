"""Pixels of image files, as stored."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def decoded(data: bytes) -> NDArray[Any] | None:
    """Pixels of an image file as stored, before any EXIF orientation; None where OpenCV cannot decode it."""
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None


def stretched(pixels: NDArray[Any]) -> NDArray[Any]:
    """Sixteen-bit pixels so that their largest value needs the last bit; others as they are.

    Twelve-bit sensors write 0 to 4095 into files of 0 to 65535: read as eight bits, sixteen grey values are left.
    """
    if pixels.dtype != np.uint16:
        return pixels
    bits = int(pixels[..., :3].max() if pixels.ndim == 3 else pixels.max()).bit_length()
    return np.asarray(pixels << (16 - bits)) if bits else pixels
