"""Keep COLMAP's log off standard error while a job runs."""

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Let COLMAP log errors only, unless the user enabled its log (``pycolmap.logging.verbose_level``)."""
    level, errors = pycolmap.logging.minloglevel, pycolmap.logging.Level.ERROR.value
    if pycolmap.logging.verbose_level == 0 and level < errors:
        pycolmap.logging.minloglevel = errors
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
