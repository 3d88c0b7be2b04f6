"""Log of a job for programs: one JSON object a line for each event, and a last one with the result."""

import json
import math
import stat
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from colmap_vg.cli.wording import one_line
from colmap_vg.errors import ColmapVgError, OptionError, OutputError
from colmap_vg.events import StageEvent

STANDARD_OUTPUT = "-"
FAILED, USAGE, INTERRUPTED = 1, 2, 130
"""Exit codes of a failed job, of wrong usage, and of a job ended by Ctrl-C, as shells give it (128 + SIGINT)."""
_FIRST_KEY = '{"time": "'
"""What every line starts with; a file that starts otherwise is not a log and is not replaced."""


@dataclass(frozen=True)
class JobResult:
    """Result of a finished job.

    Attributes
    ----------
    models : int
        Number of models in the output folder.
    registered : int
        Number of images that are in a model.
    """

    models: int
    registered: int


class JsonLog:
    """Writes the events of a job as JSON lines, each flushed at once, and at the end the job's result.

    Parameters
    ----------
    target : str
        File, which is replaced if it is such a log already; ``-`` for standard output.
    """

    def __init__(self, target: str) -> None:
        self.to_stdout = target == STANDARD_OUTPUT
        self.result: JobResult | None = None
        self._target = target
        self._stream: TextIO | None = None

    def __enter__(self) -> Self:
        self._stream = sys.stdout if self.to_stdout else _opened(Path(self._target))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stream is None:
            return
        with suppress(OutputError):  # the job has ended, and its exit code says how
            self._write_result(error)
        if not self.to_stdout:
            with suppress(OSError):
                self._stream.close()
        self._stream = None

    def event(self, event: StageEvent) -> None:
        """Write one event.

        Raises
        ------
        OutputError
            The line cannot be written.
        """
        values = asdict(event)
        self._write({name: values[name] for name in ("stage", "state", "message", "fraction", "count", "seconds")})

    def _write_result(self, error: BaseException | None) -> None:
        status, code, message = _ending(error)
        made = None if error is not None else self.result
        self._write(
            {
                "status": status,
                "exit_code": code,
                "message": message,
                "models": 0 if made is None else made.models,
                "registered": 0 if made is None else made.registered,
            }
        )

    def _write(self, values: dict[str, object]) -> None:
        if self._stream is None:
            return
        line = json.dumps({"time": _now(), **{name: _plain(value) for name, value in values.items()}}, allow_nan=False)
        try:
            self._stream.write(line + "\n")
            self._stream.flush()
        except OSError as error:
            raise _not_writable(self._target, error) from error


def _opened(path: Path) -> TextIO:
    """Open a file for writing, unless it holds something other than such a log."""
    try:
        if path.exists() and stat.S_ISREG(path.stat().st_mode):
            with path.open("rb") as file:
                start = file.read(len(_FIRST_KEY))
            if start and start != _FIRST_KEY.encode():
                raise OutputError(f"--log_json: {path} exists and is not a log of colmap-vg: choose another file")
        return path.open("w", encoding="utf-8", newline="\n")
    except OSError as error:
        raise _not_writable(str(path), error) from error


def _not_writable(target: str, error: OSError) -> OutputError:
    name = "standard output" if target == STANDARD_OUTPUT else target
    return OutputError(f"--log_json: cannot write to {name}: {error.strerror}; choose a file in an existing folder")


def _ending(error: BaseException | None) -> tuple[str, int, str]:
    """Status, exit code and message of a job that ended with this exception."""
    if error is None:
        return "finished", 0, ""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPTED, "go on with --resume"
    if isinstance(error, ColmapVgError):
        return "failed", USAGE if isinstance(error, OptionError) else FAILED, one_line(error)
    return "failed", FAILED, f"{type(error).__name__}: {one_line(error)}"


def _now() -> str:
    """The time, UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _plain(value: object) -> object:
    """A value that JSON can hold: file names that are not UTF-8 keep their bytes as escapes, NaN becomes null."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode("utf-8")
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
