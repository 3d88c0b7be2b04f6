"""Record of an output folder's last job, from which ``--resume`` decides what is finished and what may be replaced.

``OUT/.work/job.json`` holds the verb, the options and whether the job finished. Models are published before the summary
is written; if a job is killed in between, a resumed one replaces them.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.jobs.output_folder import WORK_NAME, existing_models, output_lock, refuse_models
from colmap_vg.jobs.summary import FILE_NAME as SUMMARY_NAME
from colmap_vg.jobs.summary import plain

RECORD_NAME = "job.json"


@dataclass(frozen=True)
class JobState:
    """State of the output folder when a job starts.

    Attributes
    ----------
    finished : bool
        Whether the same job finished before, and its models and summary exist.
    overwrite : bool
        Whether existing models may be replaced: on request, or because the interrupted job that is resumed left them.
    """

    finished: bool
    overwrite: bool


@contextmanager
def recorded_job(
    output_path: Path,
    verb: str,
    inputs: Mapping[str, object],
    source: Path | None,
    *,
    overwrite: bool,
    resume: bool,
) -> Iterator[JobState]:
    """Lock the output folder for a job, and record whether the job finished.

    Parameters
    ----------
    output_path : Path
    verb : str
    inputs : mapping of str to object
        The job's inputs and options.
    source : Path or None
        Database or image folder; jobs on different files are different jobs.
    overwrite, resume : bool

    Yields
    ------
    JobState

    Raises
    ------
    OutputError
        Another job is running in the folder, it cannot be written, or it holds models that must not be replaced.
    """
    with output_lock(output_path):
        path = output_path / WORK_NAME / RECORD_NAME
        job = json.loads(
            json.dumps({"verb": verb, "options": _inputs(plain(inputs)), "source": _fingerprint(source, output_path)})
        )
        before = _read(path) if resume else {}
        models = existing_models(output_path)
        if models and before == {**job, "finished": True, "files": _sizes(output_path)}:
            yield JobState(finished=True, overwrite=False)
            return
        interrupted = before.get("finished") is False
        refuse_models(output_path, overwrite or interrupted)
        atomic_write(path, json.dumps({**job, "finished": False}, indent=1))
        try:
            yield JobState(finished=False, overwrite=overwrite or interrupted)
        except BaseException:
            if not existing_models(output_path):
                path.unlink(missing_ok=True)
            raise
        atomic_write(path, json.dumps({**job, "finished": True, "files": _sizes(output_path)}, indent=1))


def _sizes(output_path: Path) -> dict[str, int]:
    """Sizes of the summary and of the models' files, bytes: models that were cut short or changed are not finished."""
    models = [model for model in existing_models(output_path) if model != output_path]
    files = [output_path / SUMMARY_NAME, *(file for model in models for file in sorted(model.iterdir()))]
    return {file.relative_to(output_path).as_posix(): file.stat().st_size for file in files if file.is_file()}


def _inputs(inputs: object) -> object:
    """Options without those that the result does not depend on."""
    if isinstance(inputs, Mapping):
        return {name: _inputs(value) for name, value in inputs.items() if name not in ("overwrite", "resume")}
    return inputs


def _fingerprint(source: Path | None, output_path: Path) -> str:
    """Hash of the names, sizes and times of a file, or of the files in a folder except those that jobs write there."""
    if source is None:
        return ""
    if source.is_dir():
        files = [path for path in sorted(source.rglob("*")) if not _is_written(path, source, output_path)]
    else:
        files = [source]
    digest = hashlib.sha256()
    for file in files:
        with suppress(OSError):  # the job itself reports files that cannot be read
            status = file.stat()
            digest.update(f"{file}\0{status.st_size}\0{status.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _is_written(file: Path, source: Path, output_path: Path) -> bool:
    """Whether a job may have written the file: its output folder is inside the image folder, or is the same folder.

    The images of a demo lie inside its output folder instead, and count as input.
    """
    output = output_path.resolve()
    if file.is_dir():
        return True  # folders count by their files
    if source.resolve() in output.parents:
        return output in file.resolve().parents
    first = file.relative_to(source).parts[0] if source.resolve() == output else ""
    return (
        first == WORK_NAME
        or first.isdecimal()
        or first.endswith((".db", ".db-wal", ".db-shm", ".json", ".csv", ".html"))
    )


def _read(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
