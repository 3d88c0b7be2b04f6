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
from paper.noise_ratios import NOISE_RATIOS, errors_by_ratio, ring_edges
from paper.position_table import MethodErrors, median_over_seeds, table_1, wins
from paper.scenes import set_conditions

from colmap_vg.datasets.one_dsfm_folder import BUNDLER_FROM_COLMAP_AXES
from colmap_vg.errors import OptionError
from colmap_vg.simulation.topology import TopologyNoise, scene_on_topology

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


@pytest.fixture
def real_folder(tmp_path):
    """Edges of a ring in a 1DSfM folder without truth: noise of 1 degree in rotations and of 2 in directions."""
    folder = tmp_path / "madrid"
    folder.mkdir()
    noise = TopologyNoise(rotation_deg=1.0, direction_deg=2.0, baseline_power=0.0, match_spread=0.0)
    graph = scene_on_topology(40, ring_edges(40, 12), layout="ring", noise=noise).graph
    F = BUNDLER_FROM_COLMAP_AXES
    relative = np.swapaxes(F @ graph.cam2_from_cam1_rotations @ F, 1, 2).reshape(-1, 9)
    directions = graph.cam2_in_cam1_directions @ F
    np.savetxt(folder / "EGs.txt", np.hstack([graph.edges, relative, directions]), fmt=["%d"] * 2 + ["%.12f"] * 12)
    return folder


def _texts(path):
    return {element.text for element in ElementTree.parse(path).iter("{http://www.w3.org/2000/svg}text")}


def _run(*arguments):
    return subprocess.run(
        [sys.executable, str(PIPELINE), *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )


def test_a_quick_run_writes_tables_and_figures(topology, real_folder, tmp_path):
    arguments = ["--topology", topology, "--sets", "Street", "Plaza", "--output_path", tmp_path / "out", "--quick"]
    arguments += ["--methods", "cross", "cls", "1C", "2O", "epipolar", "--six_vertex_draws", 3]
    arguments += ["--real_edges", real_folder]
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
    sections = {part.split("\n", 1)[0].split(":")[0]: part for part in text.split("## ")[1:]}
    assert list(sections) == [
        "Table 1",
        "The default beside them",
        "Times beside pycolmap's rotation averaging",
        "Fig. 2 and 3",
        "Fig. 4",
        "Which method at which ratio of noises",
        "Fig. 5",
    ]
    for name in ("Table 1", "Fig. 4", "Which method at which ratio of noises"):
        assert "epipolar" not in sections[name]
    with (folder / "default.csv").open() as stream:
        (default,) = csv.DictReader(stream)
    assert default["method"] == "epipolar"
    least = min(rows, key=lambda row: float(row["shared_median"]))
    ours, theirs = float(default["shared_median"]), float(least["shared_median"])
    line, sentence = sections["The default beside them"].split("| Street ")[1].split("\n", 1)
    shown = [f"**{value:.3g}**" if value == min(ours, theirs) else f"{value:.3g}" for value in (ours, theirs)]
    assert line == f"| {default['num_images']} | {least['num_images']} | {' | '.join(shown)} | {least['method']} |"
    assert f"accurate on {int(ours <= theirs)} of 1 sets" in sentence
    assert f"no fewer images on {int(int(default['num_images']) >= int(least['num_images']))}." in sentence
    times = sections["Times beside pycolmap's rotation averaging"].split("| Street ")[1].split("\n")[0].split(" | ")
    num_edges, seconds, *ratios = (float(cell.strip(" |")) for cell in times)
    assert num_edges == 8 * 30 - 36  # of the band of 30 images
    assert np.isfinite(seconds)
    assert len(ratios) == 5
    assert np.allclose(ratios, [float(row["seconds"]) / seconds for row in [*rows, default]], rtol=0.1)
    real = sections["Which method at which ratio of noises"].split(f"| {real_folder.name} ")[1].split("\n")[0]
    assert float(real.split(" | ")[-1].strip(" |")) == pytest.approx(2.0, rel=0.15)
    assert "Least error among 1C, 2O: " in sections["Which method at which ratio of noises"]
    assert "At 2, the ratio above that is nearest" in sections["Which method at which ratio of noises"]
    figures = sorted(path.name for path in folder.glob("*.svg"))
    assert {"fig2_Street.svg", "fig3.svg", "fig4.svg", "fig4_positions.svg", "ratios.svg"} <= set(figures)
    for name in figures:
        assert ElementTree.parse(folder / name).getroot().tag.endswith("svg")
    assert {"Street", "CLS", "1C"} <= _texts(folder / "fig3.svg")
    assert {real_folder.name, "1C"} <= _texts(folder / "ratios.svg")
    assert "epipolar" not in _texts(folder / "ratios.svg")
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
