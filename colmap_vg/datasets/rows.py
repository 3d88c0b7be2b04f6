"""Read rows of numbers from text files, with file and line in all error messages."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError


def read_text(path: Path) -> str:
    """Read the text of a file.

    Raises
    ------
    DataFileError
        The file is missing, is a folder, cannot be read or is not a text file.
    """
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise DataFileError(f"{path}: cannot be read ({reason})") from error


def read_rows(path: Path, num_columns: int, meaning: str) -> NDArray[np.float64]:
    """Read the numbers of a file with the same number of columns on every line.

    Empty lines and ``#`` comments are skipped.

    Parameters
    ----------
    path : Path
    num_columns : int
    meaning : str
        Description of a row for the error message.

    Returns
    -------
    (rows, num_columns) array

    Raises
    ------
    DataFileError
        The file cannot be read or a row is bad; the message names the line of the first bad one.
    """
    lines = [line.split("#", 1)[0].split() for line in read_text(path).splitlines()]
    rows: list[list[float]] = []
    for number, words in enumerate(lines, start=1):
        if not words:
            continue
        if len(words) != num_columns:
            raise DataFileError(f"{path}:{number}: {len(words)} values, expected {num_columns} ({meaning})")
        try:
            rows.append([float(w) for w in words])
        except ValueError as error:
            raise DataFileError(f"{path}:{number}: {error} ({meaning})") from error
        if not all(np.isfinite(rows[-1])):
            raise DataFileError(f"{path}:{number}: NaN or infinite value ({meaning})")
    return np.array(rows, dtype=float).reshape(-1, num_columns)
