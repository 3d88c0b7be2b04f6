"""COLMAP's own log, kept off standard error while we work."""

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Let COLMAP write errors only, unless its log was asked for (``pycolmap.logging.verbose_level``)."""
    level, errors = pycolmap.logging.minloglevel, pycolmap.logging.Level.ERROR.value
    if pycolmap.logging.verbose_level == 0 and level < errors:
        pycolmap.logging.minloglevel = errors
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
