"""Write an export beside its place, and rename it to its place once it is complete."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from colmap_vg.errors import OutputError
from colmap_vg.jobs.output_folder import rename_all

RECORD_NAME = "export.json"
"""File in an exported folder that says what it is made of. Only folders with this file are replaced."""


def check_output(output: Path, is_folder: bool, overwrite: bool, inputs: tuple[Path, ...]) -> None:
    """Raise where an export would replace something that it must not replace; nothing is created.

    Parameters
    ----------
    output : Path
    is_folder : bool
        Whether the format is a folder of files.
    overwrite : bool
        Whether an earlier export may be replaced.
    inputs : tuple of Path
        Folder of the model, then that of the photographs if there is one.

    Raises
    ------
    OutputError
    """
    place, model = output.resolve(), inputs[0].resolve()
    inside = [path for path in inputs if path.resolve().is_relative_to(place)]
    if inside or place.is_relative_to(model):
        raise OutputError(f"{output} would change the input {(inside or inputs)[0]}: choose another output_path")
    if not os.path.lexists(output):
        return
    if output.is_dir() != is_folder:
        kind, wanted = ("file", "a folder") if is_folder else ("folder", "a file")
        raise OutputError(f"{output} is a {kind}, and this format is {wanted}: choose another output_path")
    if is_folder and not any(output.iterdir()):
        return
    if is_folder and not (output / RECORD_NAME).exists():
        raise OutputError(f"{output} holds files that are no export: choose another output_path")
    if not is_folder and any(place.is_relative_to(path.resolve()) for path in inputs):
        raise OutputError(f"{output} lies in the input {inputs[-1]}: choose another output_path")
    if not overwrite:
        raise OutputError(f"{output} exists: choose another output_path, or replace it with overwrite=True")


@contextmanager
def published(output: Path, is_folder: bool, record: dict[str, object]) -> Iterator[Path]:
    """Yield a place to write an export to, and rename it to `output` at the end.

    When the export fails, an earlier one is unchanged, and folders that were created for it are removed.

    Parameters
    ----------
    output : Path
        See `check_output`.
    is_folder : bool
        Whether the place is an empty folder, or the path of a file to be written.
    record : dict
        Written to ``export.json`` of a folder, as it is at the end.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    output = output.absolute()
    made = [path for path in output.parents if not path.exists()]
    work = None
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".export.", dir=output.parent))
        staged = work / "new"
        if is_folder:
            staged.mkdir()
        yield staged
        if is_folder:
            (staged / RECORD_NAME).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        replaced = [(output, work / "old")] if os.path.lexists(output) else []
        rename_all([*replaced, (staged, output)])
    except OSError as error:
        raise OutputError(
            f"cannot write {output}: {error.strerror}; free disk space or choose another output_path"
        ) from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
        for path in made:
            with suppress(OSError):
                path.rmdir()
