"""Stage records and events."""

import pytest

from colmap_vg import events
from colmap_vg.errors import CancelledError
from colmap_vg.events import StageLog, report_progress


def test_records_events_and_warnings_in_order():
    events = []
    log = StageLog(events.append)
    with log.stage("read"):
        log.progress("half", 0.5)
        log.warn("a caveat")
        log.result("12 edges")
    assert [(e.stage, e.state) for e in events] == [
        ("read", "started"),
        ("read", "progress"),
        ("read", "warning"),
        ("read", "finished"),
    ]
    (record,) = log.records
    assert (record.stage, record.message) == ("read", "12 edges")
    assert record.seconds >= 0
    assert record.peak_memory_mib > 1
    assert log.warnings == ["a caveat"]


def test_a_stage_that_fails_leaves_no_record():
    log = StageLog()
    with pytest.raises(ValueError, match="broken"), log.stage("solve"):
        raise ValueError("broken")
    assert log.records == []


def test_long_computations_report_to_the_stage_that_runs(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(events, "MIN_INTERVAL", 0.0)
    seen = []
    log = StageLog(seen.append)
    report_progress("before any job")
    with log.stage("solve"):
        report_progress("rotations", 0.5)
    report_progress("after the stage")
    assert [(e.stage, e.state, e.message, e.fraction) for e in seen][1:-1] == [("solve", "progress", "rotations", 0.5)]
    with pytest.raises(ValueError, match="broken"), log.stage("solve"):
        raise ValueError("broken")
    report_progress("after a stage that failed")
    assert seen[-1].state == "started"


def test_reports_are_rare(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(events, "MIN_INTERVAL", 60.0)
    seen = []
    with StageLog(seen.append).stage("solve"):
        for _ in range(100):
            report_progress("rotations")
    assert [e.state for e in seen] == ["started", "finished"]


def test_what_the_callback_raises_ends_the_computation(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(events, "MIN_INTERVAL", 0.0)

    def cancel(event: events.StageEvent) -> None:
        if event.state == "progress":
            raise CancelledError("enough")

    with pytest.raises(CancelledError, match="enough"), StageLog(cancel).stage("solve"):
        report_progress("rotations")
