"""Side-by-side runs in fresh processes, their table, and what a failing run says."""

import pytest
from benchmark.mapper_runs import MapperRun, alternate, compared, read_centers, run_mapper, summarized
from paper.plots import ratios_svg

from colmap_vg.errors import ColmapVgError, OptionError
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import synthetic_views


def test_a_fresh_process_maps_and_measures(tmp_path):
    views = synthetic_views("street", 8, num_keypoints=250)
    write_synthetic_database(tmp_path / "database.db", views)
    rows = [
        f"{k:05d}.jpg {' '.join(['0'] * 9)} {' '.join(map(repr, center))}"
        for k, center in enumerate(views.projection_centers.tolist())
    ]
    (tmp_path / "truth.txt").write_text("# name, rotation, centre\n" + "\n".join(rows) + "\n")
    assert len(read_centers(tmp_path / "truth.txt")) == 8
    before = (tmp_path / "database.db").read_bytes()
    (run,) = alternate(tmp_path / "database.db", tmp_path / "truth.txt", ["ours"], 1)
    assert (run.mapper, run.num_registered, run.num_images) == ("ours", 8, 8)
    assert run.mean_error < 0.05  # metres
    assert 0.0 < sum(seconds for _, seconds, _ in run.stages) <= run.seconds * 1.01
    assert run.peak_memory_mib > 10
    assert (tmp_path / "database.db").read_bytes() == before


def test_a_run_that_fails_is_an_error_with_its_last_words(tmp_path):
    (tmp_path / "database.db").write_text("no database")
    with pytest.raises(ColmapVgError, match=r"ours on .* ended with code 1: .*database"):
        alternate(tmp_path / "database.db", None, ["ours"], 1)
    with pytest.raises(OptionError, match="no mapper"):
        run_mapper("theirs", tmp_path / "database.db")


def test_ratios_are_of_the_same_round():
    runs = [
        MapperRun(mapper, seconds, 100.0, 9, 9, 1000, 0.5, (("solve", 1.0, 90.0),) if mapper == "ours" else ())
        for mapper, seconds in [("ours", 2.0), ("global", 4.0), ("ours", 6.0), ("global", 8.0)]
    ]
    table = compared(runs)
    assert "| ours | 2 | 4.00 (2.00-6.00) | 100 | 9/9 | 1000 | 0.5 | 1.00 (1.00-1.00) |" in table
    assert "| global | 2 | 6.00 (4.00-8.00) | 100 | 9/9 | 1000 | 0.5 | 0.62 (0.50-0.75) |" in table
    assert "| solve | 1.00 | 90 |" in table


def test_the_error_is_compared_with_the_better_of_the_mappers_that_register_most():
    def runs(ours: float, of_global: float, of_incremental: float, registered: int) -> list[MapperRun]:
        return [
            MapperRun("ours", 2.0, 100.0, 9, 9, 1000, ours),
            MapperRun("global", 4.0, 100.0, 9, 9, 1000, of_global),
            MapperRun("incremental", 8.0, 100.0, 9, registered, 1000, of_incremental),
        ]

    text, ratios = summarized({"one": runs(1.0, 2.0, 0.5, 8), "two": runs(1.0, 4.0, 0.5, 9)})
    assert ratios["error / better"] == {"one": 0.5, "two": 2.0}
    assert ratios["time / global"] == {"one": 0.5, "two": 0.5}
    assert ratios["time / incremental"] == {"one": 0.25, "two": 0.25}
    assert "| geometric mean | 0.500 | 0.250 | 1.000 |" in text
    assert "one" in ratios_svg("title", "label", ratios)
    assert summarized({"one": runs(1.0, 2.0, 0.5, 8)[:1]}) == ("", {})
