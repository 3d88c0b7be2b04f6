"""What is gathered for the report: images that were left out, and pairs whose matches are shown."""

import csv
from pathlib import Path

import pytest
from report_outputs import hostile_job

from colmap_vg.report.contents import NUM_WORST, gather
from colmap_vg.report.overview import overview


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return hostile_job(tmp_path)


def change(path: Path, count: int, **values: str) -> list[dict[str, str]]:
    """Change columns of a table's first rows; return those rows."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows[:count]:
        row.update(values)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return rows[:count]


def test_images_in_no_model_are_named_by_reason(output: Path) -> None:
    removed = change(output / "images.csv", 3, model="", verdict="cut_off")
    change(output / "images.csv", 1, verdict="uncertain")
    told = overview(gather(output))
    assert (told.num_registered, told.num_images) == (7, 10)
    names = [row["image"] for row in removed]
    assert [(group.verdict, group.count, group.names) for group in told.removed] == [
        ("cut_off", 2, tuple(names[1:])),
        ("uncertain", 1, (names[0],)),
    ]


def test_matches_of_used_pairs_are_shown_beside_those_of_worse_ones(output: Path) -> None:
    change(output / "pairs.csv", 30, verdict="rotation_outlier", rotation_error_deg="90.000")
    contents = gather(output)
    verdicts = [contents.pairs[k].verdict for k in contents.matches]
    assert verdicts.count("kept") == NUM_WORST // 2
    assert verdicts.count("rotation_outlier") == NUM_WORST // 2
    shown = [
        float(contents.pairs[k].rotation_error_deg) for k in contents.matches if contents.pairs[k].verdict == "kept"
    ]
    others = [
        float(pair.rotation_error_deg)
        for k, pair in enumerate(contents.pairs)
        if pair.verdict == "kept" and k not in contents.matches
    ]
    assert min(shown) >= max(others)
