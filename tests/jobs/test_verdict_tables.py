"""Tables of verdicts: errors against a graph whose truth is known, files that survive odd names, answers from them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_vg import EdgeVerdict, ImageVerdict, SolveOptions, solve_view_graph
from colmap_vg.errors import DataFileError, OutputError
from colmap_vg.geometry import so3
from colmap_vg.jobs.verdict_tables import (
    explain_image,
    explain_job,
    explain_pair,
    read_tables,
    verdict_tables,
    write_tables,
)
from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.solver.agreement import pose_errors_deg

ODD = ['a, "b".jpg', "c\nd.jpg", "é.jpg", "x\udcff.jpg"]


@pytest.fixture(scope="module")
def solved():
    """A ring of ten images, one edge turned by 40 degrees and one pointing 50 degrees wrong; odd names."""
    scene = ring_scene(10, 6, seed=2)
    R, d = scene.graph.cam2_from_cam1_rotations.copy(), scene.graph.cam2_in_cam1_directions.copy()
    R[4] = R[4] @ so3.exp(np.radians([[0.0, 40.0, 0.0]]))[0]
    across = np.cross(d[7], [0.3, 0.4, 0.5])
    d[7] = np.cos(np.radians(50)) * d[7] + np.sin(np.radians(50)) * across / np.linalg.norm(across)
    names = (*ODD, *(f"{k}.jpg" for k in range(4, 10)))
    inliers = np.arange(100, 100 + len(R))
    graph = replace(
        scene.graph, cam2_from_cam1_rotations=R, cam2_in_cam1_directions=d, image_names=names, num_inliers=inliers
    )
    return graph, solve_view_graph(graph, SolveOptions(method="1O"))


def test_errors_are_those_that_were_made(solved):
    rotation, direction = pose_errors_deg(
        solved[0], solved[1].cam_from_world_rotations, solved[1].projection_centers, solved[1].component
    )
    expected = np.zeros((2, len(rotation)))
    expected[0, 4], expected[1, 7] = 40.0, 50.0
    np.testing.assert_allclose([rotation, direction], expected, atol=1e-5)


def test_tables_come_back_from_their_files(solved, tmp_path: Path):
    tables = verdict_tables(*solved, {"broken.jpg": "the file is empty"})
    write_tables(tmp_path, tables)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images.csv", "pairs.csv"]
    assert read_tables(tmp_path) == tables
    assert [row.image for row in tables.images[:4]] == ODD
    assert sum(row.num_pairs for row in tables.images) == 2 * len(tables.pairs)
    with pytest.raises(OutputError, match=r"images\.csv"):
        write_tables(tmp_path / "gone", tables)
    with pytest.raises(DataFileError, match="finished run"):
        read_tables(tmp_path / "gone")
    (tmp_path / "pairs.csv").write_text("image1,image2\na,b\n")
    with pytest.raises(DataFileError, match=r"pairs\.csv, line 2"):
        read_tables(tmp_path)


def test_answers_name_verdict_and_reason(solved):
    graph, solution = solved
    tables = verdict_tables(graph, solution, {"broken.jpg": "the file is empty"})
    job = "\n".join(explain_job(tables))
    assert "model 0: 10 images; " in job
    assert "of the inlier matches and " in job
    assert "broken.jpg: the file is empty" in job
    assert f"1 rotation_outlier ({EdgeVerdict.ROTATION_OUTLIER.reason})" in job
    i, j = (graph.image_names[row] for row in graph.edges[4])
    pair = "\n".join(explain_pair(tables, j, i))
    assert "rotation_outlier, 104 verified matches, rotation 40.000° off the model" in pair
    assert EdgeVerdict.ROTATION_OUTLIER.reason in pair
    image = explain_image(tables, i)
    assert ImageVerdict.REGISTERED.reason in image[0]
    assert any(line.startswith(f"  {j}: rotation_outlier") for line in image)
    with pytest.raises(DataFileError, match=r"did you mean .*4\.jpg"):
        explain_image(tables, "4.jpeg")
    assert "no verified pair" in explain_pair(tables, "broken.jpg", i)[0]


@pytest.mark.parametrize("kind", [EdgeVerdict, ImageVerdict])
def test_every_word_is_in_the_documentation(kind):
    text = (Path(__file__).parents[2] / "docs" / "output.md").read_text(encoding="utf-8")
    for verdict in kind:
        assert f"| `{verdict}` | {verdict.reason} |" in text
