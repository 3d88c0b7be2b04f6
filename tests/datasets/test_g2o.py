"""g2o files: conventions by composition, and complaints with file and line."""

import numpy as np
import pytest

from colmap_vg.datasets.g2o import read_g2o
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3
from colmap_vg.pose_graph.costs import InformationCost

UPPER = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


def _write(folder, *lines):
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def _pose(rng):
    return so3.random(1, rng)[0], rng.standard_normal(3)


def _words(values):
    return " ".join(repr(float(value)) for value in values)


def test_error_is_g2o_s(tmp_path):
    rng = np.random.default_rng(0)
    (Q1, p1), (Q2, p2) = _pose(rng), _pose(rng)
    # A measurement close to the relative pose: the rotation vector and g2o's error agree to first order.
    R12 = Q1.T @ Q2 @ so3.exp(1e-6 * rng.standard_normal(3))
    t12 = Q1.T @ (p2 - p1) + 1e-6 * rng.standard_normal(3)
    root = rng.standard_normal((6, 6))
    information = root @ root.T
    path = _write(
        tmp_path,
        f"VERTEX_SE3:QUAT 7 {_words(p1)} {_words(so3.to_quaternion(Q1))}",
        "# a comment",
        f"VERTEX_SE3:QUAT 3 {_words(p2)} {_words(so3.to_quaternion(Q2))}",
        "FIX 7",
        f"EDGE_SE3:QUAT 7 3 {_words(t12)} {_words(so3.to_quaternion(R12))} {_words(information[np.triu_indices(6)])}",
    )
    graph = read_g2o(path)
    assert graph.ids.tolist() == [7, 3]
    assert graph.edges.tolist() == [[0, 1]]
    assert np.allclose(graph.cam_from_world_rotations, [Q1.T, Q2.T], atol=1e-15)
    assert np.allclose(graph.projection_centers, [p1, p2], atol=0)
    assert np.allclose(graph.cam2_from_cam1_rotations[0], R12.T, atol=1e-15)
    error = np.concatenate([R12.T @ (Q1.T @ (p2 - p1) - t12), so3.log(R12.T @ Q1.T @ Q2)])
    cost = InformationCost(
        graph.edges, graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_translations, graph.information
    )
    value = cost.value(np.swapaxes(graph.cam_from_world_rotations, 1, 2), graph.projection_centers)
    assert value == pytest.approx(error @ information @ error, rel=1e-8)
    covariance = np.linalg.inv(information)
    kappa, tau = graph.chordal_weights()
    # SE-Sync inverts the blocks, not the matrix.
    assert kappa[0] == pytest.approx(1.5 / np.trace(np.linalg.inv(information[3:, 3:])))
    assert tau[0] == pytest.approx(3.0 / np.trace(np.linalg.inv(information[:3, :3])))
    assert kappa[0] > 1.5 / np.trace(covariance[3:, 3:])


VERTICES = ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1")


@pytest.mark.parametrize(
    ("lines", "where", "what"),
    [
        ((*VERTICES, "EDGE_SE3:QUAT 0 2 1 0 0 0 0 0 1 " + UPPER), ":3:", "from 0 to 2"),
        ((*VERTICES, "EDGE_SE3:QUAT 1 1 1 0 0 0 0 0 1 " + UPPER), ":3:", "two different vertices"),
        ((*VERTICES, "", "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0"), ":4:", "needs 30 values, found 11"),
        ((*VERTICES, "EDGE_SE3:QUAT 0 1 1 0 x 0 0 0 1 " + UPPER), ":3:", "could not convert"),
        ((*VERTICES, "EDGE_SE3:QUAT 0 1 1 0 nan 0 0 0 1 " + UPPER), ":3:", "NaN"),
        ((*VERTICES, "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 2 " + UPPER), ":3:", "quaternion"),
        ((*VERTICES, "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1"), ":3:", "twice"),
        ((*VERTICES, "VERTEX_SE3:QUAT 1.5 1 0 0 0 0 0 1"), ":3:", "not a vertex id"),
        (("VERTEX_SE2 0 0 0 0",), ":1:", "VERTEX_SE2 is unknown"),
        (("# nothing",), "graph.g2o:", "no VERTEX_SE3:QUAT"),
    ],
)
def test_complaints_name_file_and_line(tmp_path, lines, where, what):
    path = _write(tmp_path, *lines)
    with pytest.raises(DataFileError, match=what) as complaint:
        read_g2o(path)
    assert where in str(complaint.value)


def test_missing_file(tmp_path):
    with pytest.raises(DataFileError, match="absent"):
        read_g2o(tmp_path / "absent.g2o")


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["sphere2500", "parking-garage"])
def test_odometry_edges_agree_with_the_file_s_estimates(name, data_folder):
    graph = read_g2o(data_folder / "view_graphs" / "pose_graphs" / f"{name}.g2o")
    chain = np.diff(graph.edges, axis=1)[:, 0] == 1
    i, j = graph.edges[chain].T
    R, p = graph.cam_from_world_rotations, graph.projection_centers
    wrong = so3.angle(R[j] @ np.swapaxes(R[i], 1, 2) @ np.swapaxes(graph.cam2_from_cam1_rotations[chain], 1, 2))
    assert np.median(wrong) < 0.05
    offset = np.einsum("kab,kb->ka", R[i], p[j] - p[i]) - graph.cam2_in_cam1_translations[chain]
    assert np.median(np.linalg.norm(offset, axis=1)) < 0.1 * np.median(np.linalg.norm(p[j] - p[i], axis=1))
