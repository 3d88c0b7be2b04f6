"""Features and matching in a process of their own, where COLMAP may end without taking the job along.

COLMAP writes the database from threads, and a disk that gets full, a file that must not be written or memory that runs
out there ends the process (``std::terminate``). Here that is an error with a reason, and what was finished stays.
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
from os import PathLike
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import pycolmap

from colmap_vg import errors
from colmap_vg.errors import ColmapVgError, ImageFolderError, OutputError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.features.extraction import extract_features
from colmap_vg.features.matching import match_features
from colmap_vg.features.photographs import SkippedFile
from colmap_vg.options import FeatureOptions

_TASKS: dict[str, Callable[..., object]] = {"features": extract_features, "matching": match_features}
_LENGTH = struct.Struct("<Q")
_WRITE_FAULTS = ("disk is full", "disk I/O error", "readonly database", "No space left", "File too large")
"""What sqlite and the system say when a database cannot grow."""
_LITTLE_ROOM = 2**18
"""Bytes; a disk with less is full: what did not fit has been taken back."""


def extract_features_apart(
    image_path: str | PathLike[str],
    database_path: Path,
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
    descriptors: Iterable[int] = (),
) -> tuple[list[str], list[SkippedFile]]:
    """As :func:`extract_features`, in a process of its own.

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
        COLMAP could read too few photographs, or came to an end of its own.
    """
    arguments = (os.fspath(image_path), database_path, list(names), options)
    with log.stage("features"):
        readable, unreadable = _run_apart("features", arguments, database_path, log, descriptors)
    return readable, unreadable


def match_features_apart(
    database_path: Path, options: FeatureOptions, log: StageLog, descriptors: Iterable[int] = ()
) -> int:
    """As :func:`match_features`, in a process of its own; parameters and errors as above."""
    with log.stage("matching"):
        num_pairs: int = _run_apart("matching", (database_path, options), database_path, log, descriptors)
    return num_pairs


def _run_apart(
    task: str, arguments: tuple[object, ...], database_path: Path, log: StageLog, descriptors: Iterable[int]
) -> Any:
    """What a task returns in another process; its progress, warnings and result go to the log."""
    level = pycolmap.logging.minloglevel
    # The path, too: the caller may have changed it, and the same code must run there.
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
        said = errors_file.read().decode("utf-8", errors="replace")
    if answer is None:
        raise _ended(process.returncode, said, database_path)
    if "error" in answer:
        kind = getattr(errors, answer["error"], None)
        if isinstance(kind, type) and issubclass(kind, ColmapVgError):
            raise kind(answer["message"])
        raise _ended(0, f"{said}\n{answer['message']}", database_path)
    return pickle.loads(bytes.fromhex(answer["value"]))


def _talk(process: "subprocess.Popen[bytes]", request: bytes, log: StageLog) -> dict[str, str] | None:
    """Send the request, pass on what is told, and return the last word; None when the process ended without one."""
    stdin, stdout = process.stdin, process.stdout
    if stdin is None or stdout is None:  # both are pipes
        return None
    try:
        stdin.write(_LENGTH.pack(len(request)) + request)
        stdin.flush()  # and left open: its end tells the process that this one is gone
    except BrokenPipeError:
        return None
    answer = None
    for line in stdout:
        told = json.loads(line)
        if told.get("state") == "progress":
            log.progress(told["message"], told["fraction"])
        elif told.get("state") == "warning":
            log.warn(told["message"])
        else:
            answer = told
            log.result(told.get("result", ""))
    return answer


def _ended(code: int, said: str, database_path: Path) -> ColmapVgError:
    """The error for a process that ended by itself."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    fault = next((line for line in lines if any(word in line for word in _WRITE_FAULTS)), None)
    full = not database_path.parent.is_dir() or shutil.disk_usage(database_path.parent).free < _LITTLE_ROOM
    if fault is not None or full:
        reason = next((word for word in _WRITE_FAULTS if fault is not None and word in fault), "the disk is full")
        return OutputError(
            f"{database_path} cannot be written ({reason}): make room or choose another output_path, and go on with"
            " resume=True"
        )
    if -code == signal.SIGKILL:
        return ImageFolderError(
            f"the process that worked on {database_path} was killed, most likely because memory ran out: lower"
            " num_threads or max_image_size"
        )
    reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}"
    what = next((line for line in lines if "what()" in line or "Error" in line), lines[-1] if lines else "no message")
    return ImageFolderError(
        f"COLMAP ended with {reason} while it worked on {database_path} ({what}); its log tells more"
    )


def serve() -> None:
    """Do the one task that is asked for on standard input; end at once when the asking process is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the asking process, which ends this one
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what COLMAP prints must not come between the answers
    request = _request(sys.stdin.buffer)
    if request is None:
        return  # the asking process was gone before it had asked
    level, task, arguments = pickle.loads(request)
    threading.Thread(target=_end_with, args=(sys.stdin.buffer,), daemon=True).start()
    pycolmap.logging.minloglevel = level
    log = StageLog(lambda event: _pass_on(event, answers))
    try:
        value = _TASKS[task](*arguments, log)
    except ColmapVgError as error:
        answer = {"error": type(error).__name__, "message": str(error)}
    except (RuntimeError, OSError, MemoryError) as error:
        answer = {"error": "", "message": f"{type(error).__name__}: {error}"}
    else:
        answer = {"value": pickle.dumps(value).hex(), "result": log.records[-1].message}
    _tell(answers, answer)


def _request(pipe: IO[bytes]) -> bytes | None:
    """The pickled request; None where the pipe ends before it does."""
    header = pipe.read(_LENGTH.size)
    if len(header) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(header)
    request = pipe.read(length)
    return request if len(request) == length else None


def _end_with(pipe: IO[bytes]) -> None:
    pipe.read()
    os._exit(1)


def _pass_on(event: StageEvent, answers: IO[str]) -> None:
    if event.state in ("progress", "warning"):
        _tell(answers, {"state": event.state, "message": event.message, "fraction": event.fraction})


def _tell(answers: IO[str], content: dict[str, Any]) -> None:
    answers.write(json.dumps(content) + "\n")
    answers.flush()
