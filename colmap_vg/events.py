"""Stages of a job: their time, peak memory and progress, told to whoever listens."""

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

StageState = Literal["started", "progress", "finished", "warning"]


@dataclass(frozen=True)
class StageEvent:
    """Something that happened in a job.

    Attributes
    ----------
    stage : str
    state : "started", "progress", "finished" or "warning"
    message : str
        One line for people; may be empty.
    fraction : float or None
        Share of the stage that is done, when known.
    seconds : float
        Time since the stage began.
    """

    stage: str
    state: StageState
    message: str = ""
    fraction: float | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class StageRecord:
    """Time and peak memory of a finished stage.

    Attributes
    ----------
    stage : str
    seconds : float
        Wall time.
    peak_memory_mib : float
        The process's peak resident memory when the stage ended.
    message : str
        What the stage had to say of its result.
    """

    stage: str
    seconds: float
    peak_memory_mib: float
    message: str = ""


@dataclass
class StageLog:
    """Collects stage records and warnings, and passes events on.

    Parameters
    ----------
    on_event : callable, optional
        Called with each `StageEvent`, in the thread that does the work; an exception from it stops the job.
    """

    on_event: Callable[[StageEvent], None] | None = None
    records: list[StageRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _stage: str = ""
    _start: float = 0.0
    _message: str = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body as stage `name`. Stages do not nest."""
        self._stage, self._start, self._message = name, time.perf_counter(), ""
        self._emit("started")
        yield
        seconds = time.perf_counter() - self._start
        self.records.append(StageRecord(name, seconds, peak_memory_mib(), self._message))
        self._emit("finished", self._message)

    def progress(self, message: str = "", fraction: float | None = None) -> None:
        """Tell how far the current stage is."""
        self._emit("progress", message, fraction)

    def result(self, message: str) -> None:
        """Set the line that the stage's record will hold."""
        self._message = message

    def warn(self, message: str) -> None:
        """Keep a caveat for the summary and pass it on."""
        self.warnings.append(message)
        self._emit("warning", message)

    def _emit(
        self,
        state: StageState,
        message: str = "",
        fraction: float | None = None,
    ) -> None:
        if self.on_event is not None:
            seconds = time.perf_counter() - self._start if self._stage else 0.0
            self.on_event(StageEvent(self._stage, state, message, fraction, seconds))


def peak_memory_mib() -> float:
    """Peak resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
