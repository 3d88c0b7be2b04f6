"""Write files atomically."""

import os
from contextlib import suppress
from pathlib import Path

from colmap_vg.errors import OutputError


def atomic_write(path: Path, text: str) -> None:
    """Write a text file atomically: to a temporary file in the same folder, then by renaming it.

    Parameters
    ----------
    path : Path
    text : str
        Written as UTF-8; file names in it that are not UTF-8 keep their bytes.

    Raises
    ------
    OutputError
        The file cannot be written; an existing one is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape", newline="")
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise OutputError(
            f"cannot write {path}: {error.strerror}; free disk space or choose another output_path"
        ) from error
