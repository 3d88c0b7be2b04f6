"""Lock and check the output folder before a job starts, and publish complete models in it.

Models are written under ``OUT/.work`` and renamed to ``OUT/0``, ``OUT/1``, ...; a killed job leaves no partial model.
"""

import errno
import fcntl
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from os import PathLike
from pathlib import Path

from colmap_vg.errors import OutputError

WORK_NAME = ".work"
LOCK_NAME = "lock"
STAGE_NAME = "models"
LOCK_PATIENCE = 3.0
"""Seconds to wait for another job's lock, since a process of a killed job may be about to end."""
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Error numbers of file systems without locks."""
_held: ContextVar[Mapping[Path, int]] = ContextVar("_held", default={})  # noqa: B039  -- never mutated, only replaced
_MODEL_NAME = re.compile(r"\d+")
_MODEL_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")


def prepare_output(output_path: str | PathLike[str], overwrite: bool = False) -> Path:
    """Create the output folder and its work folder, and check that a model can be written.

    Parameters
    ----------
    output_path : path
        May exist already.
    overwrite : bool
        Accept a folder that holds models; `publish_models` replaces them at the end.

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
        raise _not_writable(output, error.strerror) from error
    return work


@contextmanager
def work_folder(output_path: str | PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Lock an output folder and prepare it, as :func:`output_lock` and :func:`prepare_output` do.

    When the job fails or is cancelled, models that were not published yet are removed.
    """
    with output_lock(output_path):
        work = prepare_output(output_path, overwrite)
        try:
            yield work
        except BaseException:
            shutil.rmtree(work / STAGE_NAME, ignore_errors=True)
            raise


@contextmanager
def output_lock(output_path: str | PathLike[str]) -> Iterator[None]:
    """Lock an output folder against other jobs; the kernel releases the lock however this process ends.

    The lock is reentrant. When the job fails, empty folders that were created for it are removed.

    Raises
    ------
    OutputError
        Another job is running in the folder, or it cannot be written.
    """
    work = Path(output_path).absolute() / WORK_NAME
    key = work.parent.resolve()
    if key in _held.get():
        yield
        return
    made = [path for path in (work, *work.parents) if not path.exists()]
    try:
        descriptor = _locked_file(work / LOCK_NAME, output_path)
        token = _held.set({**_held.get(), key: descriptor})
        try:
            yield
        finally:
            _held.reset(token)
            with suppress(OSError):
                (work / LOCK_NAME).unlink()
            os.close(descriptor)
    except BaseException:
        for path in made:
            with suppress(OSError):
                path.rmdir()
        raise


def lock_descriptors() -> tuple[int, ...]:
    """File descriptors of the locks that this job holds: a process that inherits them keeps the lock until it ends."""
    return tuple(_held.get().values())


def _locked_file(path: Path, output_path: str | PathLike[str]) -> int:
    """Lock the lock file, write this process's id into it, and return its descriptor."""
    deadline = time.monotonic() + LOCK_PATIENCE
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:
            if time.monotonic() < deadline:
                continue  # the other job has just removed the folder that it had created
            raise _not_writable(output_path, "its work folder is removed whenever it is created") from None
        except OSError as error:
            raise _not_writable(output_path, error.strerror) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            other = os.pread(descriptor, 32, 0).decode("ascii", errors="replace").strip()
            os.close(descriptor)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES, *_NO_LOCKS):
                raise _not_writable(output_path, error.strerror) from error
            if error.errno in _NO_LOCKS:
                return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            if time.monotonic() >= deadline:
                raise OutputError(
                    f"another job (process {other or 'unknown'}) is running in {output_path}: wait until it has ended,"
                    " or choose another output_path"
                ) from error
            time.sleep(0.05)
            continue
        # The other job may have removed the file between opening and locking it; then the lock protects nothing.
        if _inode(path) == os.fstat(descriptor).st_ino:
            with suppress(OSError):  # on a full disk the lock holds without a process id
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, f"{os.getpid()}\n".encode("ascii"), 0)
            return descriptor
        os.close(descriptor)


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None


def _not_writable(output_path: str | PathLike[str], why: str | None) -> OutputError:
    return OutputError(f"cannot write to the output folder {output_path}: {why}; choose another output_path")


def refuse_models(output_path: str | PathLike[str], overwrite: bool = False) -> None:
    """Raise `OutputError` when the folder holds a model that must not be overwritten; nothing is created."""
    models = existing_models(output_path)
    first = Path(output_path) / "0"
    if first.exists() and first not in models and not (first.is_dir() and not any(first.iterdir())):
        raise OutputError(f"{first} exists and is not a model: move it, or choose another output_path")
    if models and not overwrite:
        raise OutputError(
            f"{output_path} already holds a model ({models[0]}): choose another output_path, or replace it with "
            "overwrite=True"
        )


def existing_models(output_path: str | PathLike[str]) -> list[Path]:
    """Model folders in the output folder, including the output folder itself if it holds a model."""
    output = Path(output_path)
    if not output.is_dir():
        return []
    numbered = [path for path in output.iterdir() if path.is_dir() and _MODEL_NAME.fullmatch(path.name)]
    candidates = [output, *sorted(numbered, key=lambda path: int(path.name))]
    return [path for path in candidates if any((path / name).exists() for name in _MODEL_FILES)]


def publish_models(staged: Sequence[Path], output_path: str | PathLike[str]) -> list[Path]:
    """Rename finished models to ``output_path/0``, ``output_path/1``, ..., replacing existing ones.

    Parameters
    ----------
    staged : sequence of Path
        Folders of finished models, on the output folder's file system.
    output_path : path

    Returns
    -------
    list of Path
        The final folders of the models.

    Raises
    ------
    OutputError
        A folder cannot be renamed.
    """
    output, replaced = Path(output_path), Path(output_path) / WORK_NAME / "replaced"
    try:
        shutil.rmtree(replaced, ignore_errors=True)
        replaced.mkdir(parents=True)
        old = [(path, replaced / path.name) for path in existing_models(output) if path != output]
        new = [(path, output / str(index)) for index, path in enumerate(staged)]
        rename_all(old + new)
    except OSError as error:
        raise OutputError(f"cannot move the models to {output}: {error.strerror} ({error.filename})") from error
    shutil.rmtree(replaced, ignore_errors=True)
    with suppress(OSError):
        (output / WORK_NAME / STAGE_NAME).rmdir()
    return [target for _, target in new]


def rename_all(moves: Sequence[tuple[Path, Path]]) -> None:
    """Rename files or folders in turn, or none of them: when one fails, those before it are renamed back.

    Parameters
    ----------
    moves : sequence of (Path, Path)
        Old and new path of each, on one file system.

    Raises
    ------
    OSError
        One cannot be renamed.
    """
    moved: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            moved.append((source, target))
    except OSError:
        with suppress(OSError):
            for source, target in reversed(moved):
                target.rename(source)
        raise


def stage_models(work: Path, num_models: int) -> list[Path]:
    """Create empty folders for models on the output folder's file system, removing those of a killed job.

    Raises
    ------
    OutputError
        They cannot be created.
    """
    stage = work / STAGE_NAME
    folders = [stage / str(index) for index in range(num_models)]
    try:
        shutil.rmtree(stage, ignore_errors=True)
        for folder in folders:
            folder.mkdir(parents=True)
    except OSError as error:
        raise _not_writable(work.parent, error.strerror) from error
    return folders
