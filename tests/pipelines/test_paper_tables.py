"""The paper's tables: a quick run from end to end, and the counting behind them."""

import csv
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from paper.noise_ratios import NOISE_RATIOS, errors_by_ratio
from paper.position_table import MethodErrors, median_over_seeds, table_1, wins
from paper.scenes import set_conditions

from colmap_vg.errors import OptionError

pytestmark = pytest.mark.slow

PIPELINE = Path(__file__).parents[2] / "pipelines" / "paper_tables.py"


def _band(num_images, width):
    i, j = np.triu_indices(num_images, 1)
    near = j - i <= width
    A = sp.coo_array((np.ones(near.sum()), (i[near], j[near])), shape=(num_images, num_images))
    return sp.csc_array(A + A.T)


@pytest.fixture
def topology(tmp_path):
    folder = tmp_path / "topology"
    folder.mkdir()
    for name, num_images in (("Street", 30), ("Plaza", 60)):
        scipy.io.savemat(folder / f"{name}.mat", {"A": sp.csc_matrix(_band(num_images, 8))})
    return folder


def _run(*arguments):
    return subprocess.run(
        [sys.executable, str(PIPELINE), *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )


def test_a_quick_run_writes_tables_and_figures(topology, tmp_path):
    arguments = ["--topology", topology, "--sets", "Street", "Plaza", "--output_path", tmp_path / "out", "--quick"]
    arguments += ["--methods", "cross", "cls", "1C", "2O", "--six_vertex_draws", 3]
    finished = _run(*arguments)
    assert finished.returncode == 0, finished.stderr
    folder = tmp_path / "out" / "tables"
    assert finished.stdout.strip().endswith(str(folder / "tables.md"))
    with (folder / "table1.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["method"] for row in rows] == ["cross", "cls", "1C", "2O"]
    assert {row["dataset"] for row in rows} == {"Street"}
    assert all(np.isfinite(float(row["median"])) for row in rows)
    text = (folder / "tables.md").read_text()
    for heading in ("## Table 1", "## Fig. 2 and 3", "## Fig. 4", "## Which method", "## Fig. 5"):
        assert heading in text
    figures = sorted(path.name for path in folder.glob("*.svg"))
    assert {"fig2_Street.svg", "fig4.svg", "fig4_positions.svg", "ratios.svg"} <= set(figures)
    for name in figures:
        assert ElementTree.parse(folder / name).getroot().tag.endswith("svg")
    again = _run(*arguments)
    assert again.returncode == 1
    assert again.stderr.startswith("error: ")
    assert _run(*arguments, "--overwrite", "--resume").returncode == 0


def test_directions_correct_rotations_where_they_are_the_better_ones():
    errors = errors_by_ratio(["1O", "2O", "cls"], 3)
    assert errors["2O"].shape == (len(NOISE_RATIOS),)
    assert errors["2O"][0] < errors["1O"][0] < errors["cls"][0]
    assert (np.diff(errors["1O"]) > 0).all()


def test_unknown_sets_are_refused(topology, tmp_path):
    with pytest.raises(OptionError, match="has no set Nowhere"):
        set_conditions(topology, "Nowhere")
    finished = _run("--topology", topology, "--sets", "Nowhere", "--output_path", tmp_path / "out")
    assert finished.returncode == 1
    assert "has no set Nowhere" in finished.stderr


def test_wins_count_sets_whose_median_over_seeds_is_below_every_rival():
    row = MethodErrors("A", 0, "cls", 10, 5, 1.0, 1.0, 1.0, 0.1, 3, True, 0.1)
    medians = {("A", "cls"): (1, 1, 9), ("A", "cross"): (2, 2, 2), ("A", "1C"): (0.5, 0.9, 99)}
    medians |= {("B", "cls"): (1, 1, 1), ("B", "cross"): (0.1, 0.1, 0.1), ("B", "1C"): (0.5, 0.5, 0.5)}
    rows = [
        replace(row, dataset=d, method=m, seed=s, median=float(value))
        for (d, m), values in medians.items()
        for s, value in enumerate(values)
    ]
    assert {(r.dataset, r.method): r.median for r in median_over_seeds(rows)}["A", "1C"] == 0.9
    assert "| 1C | 1 of 2 | 1 | B |" in wins(rows)
    assert "**0.9**" in table_1(rows)
