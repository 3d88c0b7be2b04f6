"""The output folder: checked before work starts, and given whole models only.

Models are written under ``OUT/.work`` and renamed to ``OUT/0``, ``OUT/1``, ...: a killed job leaves no half model.
"""

import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path

from colmap_vg.errors import OutputError

WORK_NAME = ".work"
_MODEL_NAME = re.compile(r"\d+")
_MODEL_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")


def prepare_output(output_path: str | PathLike[str], overwrite: bool = False) -> Path:
    """Create the output folder and its work folder, and make sure that a model can be written.

    Parameters
    ----------
    output_path : path
        May exist already.
    overwrite : bool
        Accept a folder that holds models; they stay until `publish_models` replaces them.

    Returns
    -------
    Path
        The work folder, ``output_path/.work``.

    Raises
    ------
    OutputError
        The folder cannot be written, or holds a model.
    """
    output, work = Path(output_path), Path(output_path) / WORK_NAME
    try:
        refuse_models(output, overwrite)
        work.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=work) as probe:
            probe.write(b"\0")
    except OSError as error:
        raise OutputError(
            f"cannot write to the output folder {output}: {error.strerror}; choose another --output_path"
        ) from error
    return work


@contextmanager
def work_folder(output_path: str | PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """As :func:`prepare_output`; when the job fails, folders that it made and that hold nothing go again."""
    work = Path(output_path) / WORK_NAME
    made = [path for path in (work, *work.parents) if not path.exists()]
    try:
        yield prepare_output(output_path, overwrite)
    except BaseException:
        for path in made:
            with suppress(OSError):
                path.rmdir()
        raise


def refuse_models(output_path: str | PathLike[str], overwrite: bool = False) -> None:
    """Raise `OutputError` when the folder holds a model that must not be overwritten; nothing is created."""
    models = existing_models(output_path)
    if models and not overwrite:
        raise OutputError(
            f"{output_path} already holds a model ({models[0]}): choose another --output_path, or replace it with "
            "--overwrite"
        )


def existing_models(output_path: str | PathLike[str]) -> list[Path]:
    """Folders of models that the output folder holds, itself among them."""
    output = Path(output_path)
    if not output.is_dir():
        return []
    numbered = [path for path in output.iterdir() if path.is_dir() and _MODEL_NAME.fullmatch(path.name)]
    candidates = [output, *sorted(numbered, key=lambda path: int(path.name))]
    return [path for path in candidates if any((path / name).exists() for name in _MODEL_FILES)]


def publish_models(staged: Sequence[Path], output_path: str | PathLike[str]) -> list[Path]:
    """Rename finished models to ``output_path/0``, ``output_path/1``, ..., in place of those that are there.

    Parameters
    ----------
    staged : sequence of Path
        Folders of finished models, on the output's own file system.
    output_path : path

    Returns
    -------
    list of Path
        The models in their place.

    Raises
    ------
    OutputError
        A folder cannot be renamed.
    """
    output, work = Path(output_path), Path(output_path) / WORK_NAME
    replaced = work / "replaced"
    try:
        shutil.rmtree(replaced, ignore_errors=True)
        replaced.mkdir(parents=True)
        for path in existing_models(output):
            if path != output:
                path.rename(replaced / path.name)
        published = []
        for index, path in enumerate(staged):
            published.append(path.rename(output / str(index)))
        shutil.rmtree(replaced)
    except OSError as error:
        raise OutputError(f"cannot put the models into {output}: {error.strerror} ({error.filename})") from error
    return published
