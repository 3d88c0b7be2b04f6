"""Extract and match features in a separate process, so that a crash of COLMAP becomes an error with a reason.

COLMAP writes the database from threads. A full disk, a read-only file or a lack of memory there terminates the process
(``std::terminate``). The separate process keeps the job alive and the finished features in the database.
"""

import json
import os
import pickle
import shutil
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from importlib import import_module
from os import PathLike
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import pycolmap

from colmap_vg import errors
from colmap_vg.errors import ColmapVgError, ImageFolderError, OutputError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.features.photographs import SkippedFile
from colmap_vg.options import FeatureOptions

_TASKS = {"features": ("extraction", "extract_features"), "matching": ("matching", "match_features")}
"""Module and function of each task; the process imports only what it runs, since scipy takes 0.3 s."""
_LENGTH = struct.Struct("<Q")
_WRITE_FAULTS = ("disk is full", "disk I/O error", "readonly database", "No space left", "File too large")
"""Error messages of sqlite and the operating system when a database cannot grow."""
_MIN_FREE_BYTES = 2**18
"""Free bytes below which the disk counts as full; the data that did not fit have been removed again."""


def extract_features_apart(
    image_path: str | PathLike[str],
    database_path: Path,
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
    descriptors: Iterable[int] = (),
) -> tuple[list[str], list[SkippedFile]]:
    """Run :func:`extract_features` in a separate process.

    Parameters
    ----------
    image_path, database_path, names, options, log
        As for :func:`extract_features`.
    descriptors : iterable of int
        File descriptors that the process inherits, such as those of locks.

    Raises
    ------
    OutputError
        The database cannot be written.
    ImageFolderError
        COLMAP could read too few photographs, or its process ended unexpectedly.
    """
    arguments = (os.fspath(image_path), database_path, list(names), options)
    with log.stage("features"):
        readable, unreadable = _run_apart("features", arguments, database_path, log, descriptors)
    return readable, unreadable


def match_features_apart(
    database_path: Path, options: FeatureOptions, log: StageLog, descriptors: Iterable[int] = ()
) -> int:
    """Run :func:`match_features` in a separate process; see :func:`extract_features_apart`."""
    with log.stage("matching"):
        num_pairs: int = _run_apart("matching", (database_path, options), database_path, log, descriptors)
    return num_pairs


def _run_apart(
    task: str, arguments: tuple[object, ...], database_path: Path, log: StageLog, descriptors: Iterable[int]
) -> Any:
    """Run a task in a separate process and return its value; pass its progress, warnings and result to the log."""
    level = pycolmap.logging.minloglevel
    # sys.path is passed on: the caller may have changed it, and the same code must run in the process.
    code = f"import sys; sys.path[:] = {sys.path!r}; from colmap_vg.features.isolated import serve; serve()"
    with TemporaryFile() as errors_file:
        verbose = level < pycolmap.logging.Level.FATAL.value
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if verbose else errors_file,
            pass_fds=tuple(descriptors),
        )
        with process:
            try:
                answer = _talk(process, pickle.dumps((level, task, arguments)), log)
            except BaseException:
                process.kill()
                raise
        errors_file.seek(0)
        output = errors_file.read().decode("utf-8", errors="replace")
    if answer is None:
        raise _process_error(process.returncode, output, database_path)
    if "error" in answer:
        kind = getattr(errors, answer["error"], None)
        if isinstance(kind, type) and issubclass(kind, ColmapVgError):
            raise kind(answer["message"])
        raise _process_error(0, f"{output}\n{answer['message']}", database_path)
    return pickle.loads(bytes.fromhex(answer["value"]))


def _talk(process: "subprocess.Popen[bytes]", request: bytes, log: StageLog) -> dict[str, str] | None:
    """Send the request, pass messages to the log, and return the answer; None if the process ended without one."""
    stdin, stdout = process.stdin, process.stdout
    if stdin is None or stdout is None:  # both are pipes
        return None
    try:
        stdin.write(_LENGTH.pack(len(request)) + request)
        stdin.flush()  # but not closed: the process ends itself when this pipe closes
    except BrokenPipeError:
        with suppress(BrokenPipeError):
            stdin.close()  # what is left in its buffer cannot be written
        return None
    answer = None
    for line in stdout:
        message = json.loads(line)
        if message.get("state") == "progress":
            log.progress(message["message"], message["fraction"], message["count"])
        elif message.get("state") == "warning":
            log.warn(message["message"])
        else:
            answer = message
            log.result(message.get("result", ""))
    return answer


def _process_error(code: int, output: str, database_path: Path) -> ColmapVgError:
    """Make the error for a process that ended unexpectedly, from its exit code and output."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    fault = next((line for line in lines if any(word in line for word in _WRITE_FAULTS)), None)
    full = not database_path.parent.is_dir() or shutil.disk_usage(database_path.parent).free < _MIN_FREE_BYTES
    if fault is not None or full:
        reason = next((word for word in _WRITE_FAULTS if fault is not None and word in fault), "the disk is full")
        return OutputError(
            f"{database_path} cannot be written ({reason}): free disk space and continue with resume=True, or choose"
            " another output_path"
        )
    if -code == signal.SIGKILL:
        return ImageFolderError(
            f"the process that extracted or matched features for {database_path} was killed, most likely because memory"
            " ran out: lower num_threads or max_image_size"
        )
    reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}"
    what = next((line for line in lines if "what()" in line or "Error" in line), lines[-1] if lines else "no message")
    return ImageFolderError(
        f"COLMAP ended with {reason} while it extracted or matched features for {database_path} ({what}); see its log"
    )


def serve() -> None:
    """Run the task requested on standard input, and end when the parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which ends this process
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # so that COLMAP's output does not mix with the answers
    request = _request(sys.stdin.buffer)
    if request is None:
        return  # the parent ended before it sent a request
    level, task, arguments = pickle.loads(request)
    threading.Thread(target=_end_with, args=(sys.stdin.buffer,), daemon=True).start()
    pycolmap.logging.minloglevel = level
    log = StageLog(lambda event: _pass_on(event, answers))
    try:
        value = _function(task)(*arguments, log)
    except ColmapVgError as error:
        answer = {"error": type(error).__name__, "message": str(error)}
    except (RuntimeError, OSError, MemoryError) as error:
        answer = {"error": "", "message": f"{type(error).__name__}: {error}"}
    else:
        answer = {"value": pickle.dumps(value).hex(), "result": log.records[-1].message}
    _tell(answers, answer)


def _function(task: str) -> Callable[..., object]:
    module, name = _TASKS[task]
    function: Callable[..., object] = getattr(import_module(f"colmap_vg.features.{module}"), name)
    return function


def _request(pipe: IO[bytes]) -> bytes | None:
    """Read the pickled request; None if the pipe ends before it is complete."""
    header = pipe.read(_LENGTH.size)
    if len(header) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(header)
    request = pipe.read(length)
    return request if len(request) == length else None


def _end_with(pipe: IO[bytes]) -> None:
    os.read(pipe.fileno(), 1)  # not by the buffer, whose lock would be held when this process ends
    os._exit(1)


def _pass_on(event: StageEvent, answers: IO[str]) -> None:
    if event.state in ("progress", "warning"):
        _tell(
            answers, {"state": event.state, "message": event.message, "fraction": event.fraction, "count": event.count}
        )


def _tell(answers: IO[str], content: dict[str, Any]) -> None:
    answers.write(json.dumps(content) + "\n")
    answers.flush()
