"""Stage records and events."""

import pytest

from colmap_vg.events import StageLog


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
