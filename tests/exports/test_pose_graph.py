"""Pose graphs are read by this package's reader, and their edges agree with their vertices."""

from pathlib import Path

import numpy as np
import pytest
from exported_models import make_model

from colmap_vg.datasets.g2o import PoseGraph, read_g2o
from colmap_vg.exports.pose_graph import MIN_SHARED_POINTS, write_g2o
from colmap_vg.exports.source import find_source
from colmap_vg.jobs.verdict_tables import ImageRow, PairRow, VerdictTables, write_tables
from colmap_vg.scene.verdicts import EdgeVerdict

NAMES = ["a/x.jpg", "b/x.jpg", "two\nlines 'é' #1.jpg"]


def edges_agree(graph: PoseGraph) -> None:
    for (i, j), R, t in zip(graph.edges, graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_translations, strict=True):
        Ri, Rj = graph.cam_from_world_rotations[[i, j]]
        ci, cj = graph.projection_centers[[i, j]]
        np.testing.assert_allclose(R, Rj @ Ri.T, atol=1e-9)
        np.testing.assert_allclose(t, Ri @ (cj - ci), atol=1e-9)


def test_covisible_images_are_linked(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model", names=NAMES)
    for point_id in sorted(model.points3D)[: 40 - MIN_SHARED_POINTS + 1]:  # images 1 and 2 share one point too few
        model.delete_observation(
            1, next(e for e in model.point3D(point_id).track.elements if e.image_id == 1).point2D_idx
        )
    model.write(tmp_path / "model")
    (note,) = write_g2o(find_source(tmp_path / "model"), tmp_path / "graph.g2o")
    graph = read_g2o(tmp_path / "graph.g2o")
    assert graph.ids.tolist() == [1, 2, 3]
    assert graph.edges.tolist() == [[1, 2]]
    np.testing.assert_allclose(graph.information, 40.0 * np.eye(6)[None], atol=1e-9)
    assert note.startswith("1 edges: pairs that share 15 points or more")
    for row, image_id in enumerate(graph.ids.tolist()):
        image = model.image(image_id)
        np.testing.assert_allclose(
            graph.cam_from_world_rotations[row], image.cam_from_world().rotation.matrix(), atol=1e-12
        )
        np.testing.assert_allclose(graph.projection_centers[row], image.projection_center(), atol=1e-12)
    edges_agree(graph)


def test_pairs_of_a_job_are_those_that_it_used(tmp_path: Path) -> None:
    make_model(tmp_path / "job" / "0", names=NAMES)
    pairs = [
        PairRow(NAMES[1], NAMES[0], str(EdgeVerdict.KEPT), "77", "", ""),
        PairRow(NAMES[1], NAMES[2], str(EdgeVerdict.ROTATION_ONLY), "20", "", ""),
        PairRow(NAMES[0], NAMES[2], "rotation_outlier", "90", "", ""),
        PairRow(NAMES[0], "elsewhere.jpg", str(EdgeVerdict.KEPT), "90", "", ""),
    ]
    images = [ImageRow(name, "0", "registered", 2, 2) for name in NAMES]
    write_tables(tmp_path / "job", VerdictTables(tuple(images), tuple(pairs)))
    (note,) = write_g2o(find_source(tmp_path / "job"), tmp_path / "graph.g2o")
    graph = read_g2o(tmp_path / "graph.g2o")
    assert graph.edges.tolist() == [[0, 1], [1, 2]]
    assert graph.information[:, 0, 0] == pytest.approx([77.0, 20.0])
    assert note.startswith("2 edges: pairs that the job used")
    edges_agree(graph)


def test_a_model_without_points_has_vertices_only(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    model.delete_all_points2D_and_points3D()
    model.write(tmp_path / "model")
    write_g2o(find_source(tmp_path / "model"), tmp_path / "graph.g2o")
    assert read_g2o(tmp_path / "graph.g2o").edges.shape == (0, 2)
