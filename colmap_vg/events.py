"""Stages of a job: time, peak memory, progress and warnings, passed to a callback."""

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Literal

MIN_INTERVAL = 0.2
"""Minimum time between two events of :func:`report_progress`, seconds."""
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
        Called with each `StageEvent` in the thread that runs the job. An exception from it stops the job, which
        removes what is unfinished, and is passed on to the caller; see `colmap_vg.CancelledError`.
    """

    on_event: Callable[[StageEvent], None] | None = None
    records: list[StageRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _stage: str = ""
    _start: float = 0.0
    _message: str = ""
    _last_event: float = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Run the body as stage `name` and record its time. Stages do not nest."""
        self._stage, self._start, self._message = name, time.perf_counter(), ""
        self._emit("started")
        token = _running.set(self)
        try:
            yield
        finally:
            _running.reset(token)
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
        self._last_event = time.perf_counter()
        if self.on_event is not None:
            seconds = time.perf_counter() - self._start if self._stage else 0.0
            self.on_event(StageEvent(self._stage, state, message, fraction, seconds, count))


_running: ContextVar[StageLog | None] = ContextVar("_running", default=None)
"""Log of the job whose stage runs in this thread."""


def report_progress(message: str = "", fraction: float | None = None) -> None:
    """Emit an event on the progress of the stage that runs in this thread, if there is one and it was silent for long.

    Long computations call this between their steps, so that a job can tell that it is alive, and can be cancelled.
    It passes on what the job's callback raises: it must not be called where exceptions are handled.

    Parameters
    ----------
    message : str
        What is done next.
    fraction : float, optional
        Share of the stage that is done.
    """
    log = _running.get()
    if log is not None and time.perf_counter() - log._last_event >= MIN_INTERVAL:
        log.progress(message, fraction)


def peak_memory_mib() -> float:
    """Peak resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
