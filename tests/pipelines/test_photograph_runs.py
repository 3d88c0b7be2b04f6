"""Both ways from photographs to a model end in one, with the time of each stage, and their ratios are told."""

from pathlib import Path

import numpy as np
import pytest
from benchmark.photograph_runs import STAGES, PhotographRun, alternate_ways, compared_ways, run_photographs
from rendered_corner import render_corner

from colmap_vg.errors import ColmapVgError, OptionError

pytestmark = pytest.mark.slow


def run(way: str, seconds: float, inliers: int, error: float | None) -> PhotographRun:
    stages = tuple((stage, seconds, 2 * seconds) for stage in STAGES)
    return PhotographRun(way, stages, 10, 8, inliers, 5, 5, 100, error)


def test_ratios_are_of_the_same_turn() -> None:
    runs = [run("ours", 1, 90, 2.0), run("colmap", 4, 100, 1.0), run("ours", 3, 90, 2.0), run("colmap", 4, 100, 1.0)]
    last = compared_ways(runs).splitlines()[-1]
    assert last.startswith("| ours / colmap | 0.500 (0.500) |")
    assert last.endswith("| 1.000 | 0.900 | 1.000 | 2.000 |")
    without_truth = compared_ways([run("ours", 1, 90, None), run("colmap", 4, 100, None)]).splitlines()
    assert [cell.strip() for cell in without_truth[-1].split("|")][-2] == ""


def test_both_ways_make_a_model_of_a_folder(tmp_path: Path) -> None:
    corner = render_corner(5)
    corner.write(tmp_path / "images")
    numbers = np.concatenate([np.tile(np.eye(3).ravel(), (5, 1)), corner.centers], axis=1)
    rows = "".join(f"{k:02d}.jpg {' '.join(map(str, row))}\n" for k, row in enumerate(numbers))
    (tmp_path / "truth.txt").write_text(rows)
    ours, theirs = alternate_ways(tmp_path / "images", tmp_path / "truth.txt", 1, "low")
    assert (ours.way, theirs.way) == ("ours", "colmap")
    for one in (ours, theirs):
        assert one.num_images == one.num_registered == 5
        assert [stage for stage, _, _ in one.stages] == list(STAGES)
        assert all(wall > 0 and cpu > 0 for _, wall, cpu in one.stages)
        assert one.mean_error is not None
        assert one.mean_error < 0.2
    assert 0.6 < ours.num_inlier_matches / theirs.num_inlier_matches < 1.4  # other features, but as many


def test_what_cannot_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="choose one of ours, colmap"):
        run_photographs("theirs", tmp_path, None)  # type: ignore[arg-type]
    with pytest.raises(ColmapVgError, match="ours on"):
        alternate_ways(tmp_path, None, 1)
