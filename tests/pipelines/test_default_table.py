"""The default beside the paper's methods: shared images, medians over seeds, counts, times, resumed files."""

from dataclasses import make_dataclass, replace

import numpy as np
import pytest
from paper import scene_reports
from paper.default_table import default_table, times_table
from paper.position_table import MethodErrors, median_over_seeds, solve_with, with_shared_medians
from paper.scene_reports import SceneJob
from paper.scenes import KnownScene

from colmap_vg.metrics import position_errors
from colmap_vg.simulation.ring_scenes import ring_scene

ROW = MethodErrors("A", 0, "cls", 10, 5, 1.0, 1.0, 1.0, 0.1, 3, True, 0.1)


def _rows(values):
    """A row for each seed of each (set, method): (images, median over shared images)."""
    return [
        replace(ROW, dataset=dataset, method=method, seed=seed, num_images=n, shared_median=error)
        for (dataset, method), seeds in values.items()
        for seed, (n, error) in enumerate(seeds)
    ]


def test_the_default_is_beside_the_least_error_of_the_others_by_medians_over_seeds():
    rows = _rows(
        {
            ("A", "cls"): [(30, 5.0), (30, 6.0), (30, 7.0)],
            ("A", "2O"): [(30, 2.0), (30, 3.0), (30, 99.0)],
            ("A", "epipolar"): [(28, 4.0), (29, 4.5), (30, 0.1)],
            ("B_b", "cls"): [(20, 2.0)] * 3,
            ("B_b", "2O"): [(20, 2.5)] * 3,
            ("B_b", "epipolar"): [(20, 2.0)] * 3,
            ("C", "cls"): [(20, 2.0)],
            ("D", "cls"): [(20, 2.0)],
            ("D", "epipolar"): [(19, 1.0)],
        }
    )
    text = default_table(rows)
    assert "| A | 29 | 30 | 4 | **3** | 2O |" in text
    assert "| B b | 20 | 20 | **2** | **2** | cls |" in text
    assert "| D | 19 | 20 | **1** | 2 | cls |" in text
    assert "| C |" not in text  # solved without the default
    assert "at least as accurate on 2 of 3 sets, and registers no fewer images on 1." in text


def test_times_are_medians_of_ratios_not_ratios_of_medians():
    seconds = {"cls": (1.0, 4.0, 9.0), "epipolar": (2.0, 2.0, 2.0)}
    rows = [
        replace(ROW, method=method, seed=seed, seconds=value)
        for method, values in seconds.items()
        for seed, value in enumerate(values)
    ]
    averaging = {("A", 0): 10.0, ("A", 1): 1.0, ("A", 2): 2.0}
    text = times_table(rows, {"A": 123}, averaging)
    assert "| set | edges | pycolmap, s | cls | default |" in text
    assert "| A | 123 | 2 | 4 | 1 |" in text


@pytest.fixture(scope="module")
def solved():
    scene = ring_scene(20, 6, rotation_sigma=0.01, direction_sigma=0.03, seed=1)
    known = KnownScene("ring", scene.graph, scene.cam_from_world_rotations, scene.projection_centers)
    return known, {method: solve_with(known, method, 0) for method in ("cls", "1C", "epipolar")}


def _without(solved, method, images):
    solution, row = solved[method]
    registered = solution.registered.copy()
    registered[images] = False
    return {**solved, method: (replace(solution, registered=registered), row)}


def test_shared_medians_are_over_the_images_that_all_register(solved):
    scene, solutions = solved
    rows = with_shared_medians(scene, _without(solutions, "epipolar", np.arange(8)))
    assert [row.method for row in rows] == ["cls", "1C", "epipolar"]
    for row in rows:
        centers = solutions[row.method][0].projection_centers
        wanted = position_errors(centers[8:], scene.projection_centers[8:]).median
        assert row.shared_median == pytest.approx(wanted)
        assert row.shared_median != row.median


def test_shared_medians_without_the_default_or_without_images(solved):
    scene, solutions = solved
    alone = with_shared_medians(scene, {"cls": solutions["cls"]})
    assert np.isnan(alone[0].shared_median)
    none = with_shared_medians(scene, _without(solutions, "epipolar", np.arange(18)))
    assert all(row.shared_median == np.inf for row in none)
    assert median_over_seeds(none)[0].shared_median == np.inf


def test_other_fields_of_a_report_give_its_file_another_name(monkeypatch):
    job = SceneJob("Alamo", "nowhere", None, ("cls",))
    before = job.key
    assert job.key == before
    monkeypatch.setattr(scene_reports, "SceneReport", make_dataclass("SceneReport", ["rows", "another"]))
    assert job.key != before
