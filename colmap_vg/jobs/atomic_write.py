"""Files that appear whole or not at all."""

import os
from contextlib import suppress
from pathlib import Path

from colmap_vg.errors import OutputError


def atomic_write(path: Path, text: str) -> None:
    """Write a text file beside its place, and move it there.

    Parameters
    ----------
    path : Path
    text : str
        Written as UTF-8; names of files that are not UTF-8 keep their bytes.

    Raises
    ------
    OutputError
        It cannot be written; what stood there before still does.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape", newline="")
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise OutputError(f"cannot write {path}: {error.strerror}; make room or choose another output_path") from error
