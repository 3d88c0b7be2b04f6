"""Read files of known positions: of cameras, and of survey points with the places where photographs show them."""

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError

Array = NDArray[np.float64]


@dataclass
class SurveyPoint:
    """A point with a known position, and its keypoints (name of the image, pixel)."""

    position: tuple[float, float, float]
    keypoints: list[tuple[str, tuple[float, float]]] = field(default_factory=list)


def read_positions(path: str | PathLike[str]) -> dict[str, tuple[float, float, float]]:
    """Read positions of cameras: a line ``NAME X Y Z`` for each image, as COLMAP's model_aligner takes them.

    Raises
    ------
    DataFileError
        The file cannot be read, a line is no such row, or an image has two positions.
    """
    found: dict[str, tuple[float, float, float]] = {}
    for number, line in _lines(path):
        words = line.rsplit(maxsplit=3)
        x, y, z = _numbers(words[1:], 3, f"{path}, line {number}: expected NAME X Y Z, found {line!r}")
        if words[0] in found:
            raise DataFileError(f"{path}, line {number}: {words[0]} has a second position")
        found[words[0]] = (x, y, z)
    return found


def read_survey_points(path: str | PathLike[str]) -> dict[str, SurveyPoint]:
    """Read survey points: a line ``POINT X Y Z IMAGE U V`` for each photograph that shows a point.

    U and V are pixels from the upper left corner of the image, whose first pixel has its middle at 0.5.

    Raises
    ------
    DataFileError
        The file cannot be read, a line is no such row, or a point has two positions.
    """
    found: dict[str, SurveyPoint] = {}
    for number, line in _lines(path):
        where = f"{path}, line {number}: expected POINT X Y Z IMAGE U V, found {line!r}"
        head, _, rest = line.partition(" ")
        words = rest.split(maxsplit=3)
        tail = words[3].rsplit(maxsplit=2) if len(words) == 4 else []
        x, y, z = _numbers(words[:3], 3, where)
        u, v = _numbers(tail[1:], 2, where)
        point = found.setdefault(head, SurveyPoint((x, y, z)))
        if point.position != (x, y, z):
            raise DataFileError(f"{path}, line {number}: point {head} has a second position")
        point.keypoints.append((tail[0], (u, v)))
    return found


def _lines(path: str | PathLike[str]) -> list[tuple[int, str]]:
    """Numbered lines of a file, without empty ones and comments."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataFileError(f"cannot read the positions {path}: {error}") from error
    told = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip() and line.strip()[0] != "#"]
    if not told:
        raise DataFileError(f"{path}: holds no position")
    return told


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataFileError(where) from error
    if len(values) != count or not np.isfinite(values).all():
        raise DataFileError(where)
    return values
