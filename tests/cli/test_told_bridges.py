"""What `explain` takes from the summary: the links between and within models."""

from pathlib import Path

import pytest
from linked_scenes import near, street, write_scene

from colmap_vg.cli.jobs import explain, mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.errors import OutputError
from colmap_vg.jobs.summary import told_bridges
from colmap_vg.options import MappingOptions


def test_two_halves_are_told_what_is_missing(tmp_path: Path) -> None:
    poses, points = street(20)
    pairs = [(i, j) for i, j in near(20, 3) if (i < 10) == (j < 10)]
    write_scene(tmp_path / "a.db", poses, points, pairs)
    mapper(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), False, Reporter(quiet=True))
    told = told_bridges(tmp_path / "out")
    assert any(line.startswith("no pair links models 0 and 1: add two or more photographs") for line in told)
    lines = explain(tmp_path / "out", None, None)
    assert [line for line in lines if line.strip() in told]


@pytest.mark.parametrize("content", [None, "{", "{}", '{"bridges": [{}]}'])
def test_a_summary_that_is_missing_or_damaged_is_an_error(content: str | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    with pytest.raises(OutputError, match="run the job again"):
        told_bridges(tmp_path)
