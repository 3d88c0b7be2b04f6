"""What became of an output folder's last job, so that ``--resume`` knows what it may replace and what is done.

``OUT/.work/job.json`` holds the verb, the options and whether the job came to its end. Models are published before the
summary is written: models of a job that was killed in between are the job's own, and a resumed one replaces them.
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
    """What a job finds in its output folder.

    Attributes
    ----------
    finished : bool
        The same job came to its end before, and its models and summary are there.
    overwrite : bool
        Models that are there may be replaced: asked for, or left by the interrupted job that is resumed.
    """

    finished: bool
    overwrite: bool


@contextmanager
def recorded_job(
    output_path: Path,
    verb: str,
    asked: Mapping[str, object],
    source: Path | None,
    *,
    overwrite: bool,
    resume: bool,
) -> Iterator[JobState]:
    """Lock the output folder for a job, and keep the record of how far it came.

    Parameters
    ----------
    output_path : Path
    verb : str
    asked : mapping of str to object
        The job's inputs and options.
    source : Path or None
        Database or image folder: the same job is one on the same files.
    overwrite, resume : bool

    Yields
    ------
    JobState

    Raises
    ------
    OutputError
        Another job is at work in the folder, it cannot be written, or it holds models that must not be replaced.
    """
    with output_lock(output_path):
        path = output_path / WORK_NAME / RECORD_NAME
        job = json.loads(
            json.dumps({"verb": verb, "options": _inputs(plain(asked)), "source": _fingerprint(source, output_path)})
        )
        before = _read(path) if resume else {}
        models = existing_models(output_path)
        if models and before == {**job, "finished": True} and (output_path / SUMMARY_NAME).exists():
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
        atomic_write(path, json.dumps({**job, "finished": True}, indent=1))


def _inputs(asked: object) -> object:
    """The options that a result depends on."""
    if isinstance(asked, Mapping):
        return {name: _inputs(value) for name, value in asked.items() if name not in ("overwrite", "resume")}
    return asked


def _fingerprint(source: Path | None, output_path: Path) -> str:
    """Names, sizes and times of a file, or of the files in a folder but for those that jobs write there."""
    if source is None:
        return ""
    if source.is_dir():
        files = [path for path in sorted(source.rglob("*")) if not _is_written(path, source, output_path)]
    else:
        files = [source]
    digest = hashlib.sha256()
    for file in files:
        with suppress(OSError):  # the job itself will tell
            status = file.stat()
            digest.update(f"{file}\0{status.st_size}\0{status.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _is_written(file: Path, source: Path, output_path: Path) -> bool:
    """Whether a job writes the file, or may have: its output lies in the folder of its photographs, or is that folder.

    The photographs of a demo lie in its output folder, the other way round.
    """
    output = output_path.resolve()
    if file.is_dir():
        return True  # by its files
    if source.resolve() in output.parents:
        return output in file.resolve().parents
    first = file.relative_to(source).parts[0] if source.resolve() == output else ""
    return first == WORK_NAME or first.isdecimal() or first.endswith((".db", ".db-wal", ".db-shm", ".json", ".csv"))


def _read(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
