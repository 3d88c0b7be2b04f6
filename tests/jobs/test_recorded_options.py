"""Options of finished jobs, as their summaries record them."""

from pathlib import Path

import pytest

from colmap_vg import MappingOptions, ReadOptions, SolveOptions
from colmap_vg.errors import OutputError
from colmap_vg.jobs.recorded_options import recorded_options
from colmap_vg.jobs.summary import job_summary

OPTIONS = MappingOptions(
    read=ReadOptions(min_num_inliers=20, excluded_pairs_path="pairs.txt"),
    solve=SolveOptions(method="2C", rotation_gate_deg=7.0),
    ba_refine_focal_length=False,
    random_seed=3,
)


def test_options_of_mapping_jobs_come_back() -> None:
    summary = job_summary("mapper", {"database_path": Path("a.db"), "mapping": OPTIONS}, [], [])
    assert recorded_options(summary, Path("out")) == OPTIONS


def test_options_of_the_viewing_graph_alone_come_back() -> None:
    summary = job_summary("solve", {"read": OPTIONS.read, "solve": OPTIONS.solve}, [], [])
    found = recorded_options(summary, Path("out"))
    assert (found.read, found.solve) == (OPTIONS.read, OPTIONS.solve)


def test_a_demo_has_its_seed_and_the_defaults() -> None:
    assert recorded_options(job_summary("demo", {"seed": 5}, [], []), Path("out")) == MappingOptions(random_seed=5)


@pytest.mark.parametrize(
    "options",
    [
        None,
        {"mapping": {"colour": 1}},
        {"mapping": {"solve": {"method": "?"}}},
        {"mapping": {"solve": 3}},
        {"mapping": {"random_seed": "x"}},
    ],
)
def test_damage_is_told(options: object) -> None:
    with pytest.raises(OutputError, match=r"out/summary\.json is damaged"):
        recorded_options({"options": options}, Path("out"))
