"""Shows the events of a job: a live line on a terminal, plain lines otherwise, and keeps them for the summary."""

import sys
import time
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Self

from colmap_vg.cli.json_log import JobResult, JsonLog
from colmap_vg.events import StageEvent, StageRecord, peak_memory_mib

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

MIN_PACE_SECONDS = 1.0
"""Seconds of a stage from which a rate and the time left are told."""
PLAIN_INTERVAL = 10.0
"""Seconds between two plain progress lines of one stage, so that log files stay short."""


@dataclass
class Reporter:
    """Shows stage events and remembers stages and warnings.

    Parameters
    ----------
    quiet : bool
        Show nothing; stages and warnings are remembered all the same.
    verbose : bool
        Show every event.
    json_log : JsonLog, optional
        Receives every event, too, whatever is shown.
    """

    quiet: bool = False
    verbose: bool = False
    json_log: JsonLog | None = None
    records: list[StageRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _progress: "Progress | None" = None
    _task: "TaskID | None" = None
    _last_line: float = 0.0
    _first: StageEvent | None = None

    def __enter__(self) -> Self:
        if not self.quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TimeElapsedColumn(),
            )
            self._progress = Progress(*columns, console=Console(highlight=False), transient=True)
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def on_event(self, event: StageEvent) -> None:
        """Take one event of the job."""
        if self.json_log is not None:
            self.json_log.event(event)
        if event.state == "warning":
            self._warn(event.message)
        elif event.state == "finished":
            self.records.append(StageRecord(event.stage, event.seconds, peak_memory_mib(), event.message))
            self._clear_task()
            self.say(f"{event.stage}: {event.message or 'done'} ({event.seconds:.1f} s)")
        elif event.state == "started":
            self._last_line, self._first = time.perf_counter(), None
            self._start_task(event.stage)
            if self.verbose:
                self.say(f"{event.stage}: started")
        else:
            self._advance(event)

    def warn(self, message: str) -> None:
        """Show a caveat that belongs to no stage and keep it for the summary."""
        if self.json_log is not None:
            self.json_log.event(StageEvent("", "warning", message))
        self._warn(message)

    def finish(self, models: int, registered: int) -> None:
        """Take the number of models and of images in them for the log's last line."""
        if self.json_log is not None:
            self.json_log.result = JobResult(models, registered)

    def _warn(self, message: str) -> None:
        self.warnings.append(message)
        self.say(f"warning: {message}")

    def say(self, line: str) -> None:
        """Show a line."""
        if self.quiet:
            return
        if self._progress is not None:
            self._progress.console.print(line, markup=False, soft_wrap=True)
        else:
            print(line, flush=True)

    def _start_task(self, stage: str) -> None:
        if self._progress is not None:
            self._clear_task()
            self._task = self._progress.add_task(stage, total=None)

    def _clear_task(self) -> None:
        if self._progress is not None and self._task is not None:
            self._progress.remove_task(self._task)
            self._task = None

    def _advance(self, event: StageEvent) -> None:
        line = f"{event.stage}: {event.message}" if event.message else event.stage
        pace = self._pace(event)
        if self._progress is not None and self._task is not None:
            total = None if event.fraction is None else 1.0
            description = ", ".join([line, *pace])
            self._progress.update(self._task, description=description, total=total, completed=event.fraction or 0.0)
        due = time.perf_counter() - self._last_line > PLAIN_INTERVAL
        if self.verbose or (self._progress is None and due):
            self._last_line = time.perf_counter()
            share = [] if event.fraction is None else [f"{100 * event.fraction:.0f} %"]
            self.say(f"{line} ({', '.join([*share, *pace])})" if share or pace else line)

    def _pace(self, event: StageEvent) -> list[str]:
        """Rate in photographs or pairs a second, and the time left, from the stage's first event with a share on."""
        if event.fraction is None:
            return []
        if self._first is None or self._first.fraction is None or event.fraction < self._first.fraction:
            self._first = event
        first, pace = self._first, []
        seconds, done = event.seconds - first.seconds, event.fraction - (first.fraction or 0.0)
        if seconds < MIN_PACE_SECONDS or done <= 0.0:
            return []
        if event.count is not None and first.count is not None and event.count > first.count:
            pace.append(f"{(event.count - first.count) / seconds:.1f}/s")
        return [*pace, f"{_duration(seconds * (1.0 - event.fraction) / done)} left"]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
