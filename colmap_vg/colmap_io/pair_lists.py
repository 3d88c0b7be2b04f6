"""Read and write the user's lists of image pairs: pairs to exclude, and trusted pairs that are never removed."""

import json
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError


def read_pair_list(path: str | PathLike[str]) -> list[tuple[str, str]]:
    """Read pairs of image names from a text file.

    Parameters
    ----------
    path : path
        Two names per line, as in COLMAP's match lists, separated by a tab if names contain spaces. Empty lines and
        lines that start with ``#`` are skipped. A line that starts with ``["`` is a JSON list of two names, which may
        contain anything.

    Returns
    -------
    list of (str, str)

    Raises
    ------
    DataFileError
        The file cannot be read, or a line does not contain two names.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    except OSError as error:
        raise DataFileError(f"cannot read the list of pairs {path}: {error.strerror}") from error
    pairs = []
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.startswith("#"):
            names = _names(line)
            if len(names) != 2:
                raise DataFileError(f"{path}, line {number}: two image names expected, found {line.strip()!r}")
            pairs.append((names[0], names[1]))
    return pairs


def _names(line: str) -> list[str]:
    if line.startswith('["'):
        try:
            found = json.loads(line)
        except ValueError:
            found = []
        if isinstance(found, list) and all(isinstance(name, str) for name in found):
            return found
    return [name.strip() for name in line.split("\t")] if "\t" in line else line.split()


def pair_list(pairs: Iterable[tuple[str, str]]) -> str:
    r"""Text that :func:`read_pair_list` reads as the given pairs of image names, whatever these contain.

    >>> pair_list([("a.jpg", "b.jpg"), ("c d.jpg", "e.jpg")])
    'a.jpg\tb.jpg\n["c d.jpg", "e.jpg"]\n'
    """
    lines = []
    for names in pairs:
        plain = all(name and name.isprintable() and " " not in name and name[0] not in "#[" for name in names)
        lines.append("\t".join(names) if plain else json.dumps(names))
    return "".join(f"{line}\n" for line in lines)


def listed_edges(path: str | PathLike[str] | None, names: Sequence[str], edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each edge (m, 2) is in a list of pairs, with its names in either order, (m,).

    Pairs in the list without verified matches are ignored.

    Raises
    ------
    DataFileError
        As :func:`read_pair_list`, or a name is not that of an image of the database.
    """
    listed = np.zeros(len(edges), dtype=bool)
    if path is None:
        return listed
    row_of = {name: row for row, name in enumerate(names)}
    pairs = read_pair_list(path)
    unknown = sorted({name for pair in pairs for name in pair if name not in row_of})
    if unknown:
        raise DataFileError(f"{path}: {len(unknown)} names are not images of the database (first: {unknown[0]!r})")
    keys = np.array([sorted((row_of[a], row_of[b])) for a, b in pairs], dtype=np.int64).reshape(-1, 2)
    n = len(names)
    own = np.sort(edges, axis=1)
    return np.asarray(np.isin(own[:, 0] * n + own[:, 1], keys[:, 0] * n + keys[:, 1]))
