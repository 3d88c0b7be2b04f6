"""Stages of a job: time, peak memory, progress and warnings, passed to a callback."""

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

StageState = Literal["started", "progress", "finished", "warning"]


@dataclass(frozen=True)
class StageEvent:
    """Event of a job: a stage starts, progresses, ends or warns.

    Attributes
    ----------
    stage : str
    state : "started", "progress", "finished" or "warning"
    message : str
        One line for users; may be empty.
    fraction : float or None
        Share of the stage that is done, 0 to 1; None if unknown.
    seconds : float
        Time since the stage started.
    count : int or None
        Number of photographs or pairs that are done; None where nothing is counted.
    """

    stage: str
    state: StageState
    message: str = ""
    fraction: float | None = None
    seconds: float = 0.0
    count: int | None = None


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
        One line on the stage's result.
    """

    stage: str
    seconds: float
    peak_memory_mib: float
    message: str = ""


@dataclass
class StageLog:
    """Log of a job that collects stage records and warnings, and passes events to a callback.

    Parameters
    ----------
    on_event : callable, optional
        Called with each `StageEvent` in the thread that runs the job; an exception from it stops the job.
    """

    on_event: Callable[[StageEvent], None] | None = None
    records: list[StageRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _stage: str = ""
    _start: float = 0.0
    _message: str = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Run the body as stage `name` and record its time. Stages do not nest."""
        self._stage, self._start, self._message = name, time.perf_counter(), ""
        self._emit("started")
        yield
        seconds = time.perf_counter() - self._start
        self.records.append(StageRecord(name, seconds, peak_memory_mib(), self._message))
        self._emit("finished", self._message)

    def progress(self, message: str = "", fraction: float | None = None, count: int | None = None) -> None:
        """Emit an event on the progress of the current stage."""
        self._emit("progress", message, fraction, count)

    def result(self, message: str) -> None:
        """Set the line on the result of the current stage for its record."""
        self._message = message

    def warn(self, message: str) -> None:
        """Store a warning for the summary and emit it as an event."""
        self.warnings.append(message)
        self._emit("warning", message)

    def _emit(
        self,
        state: StageState,
        message: str = "",
        fraction: float | None = None,
        count: int | None = None,
    ) -> None:
        if self.on_event is not None:
            seconds = time.perf_counter() - self._start if self._stage else 0.0
            self.on_event(StageEvent(self._stage, state, message, fraction, seconds, count))


def peak_memory_mib() -> float:
    """Peak resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
