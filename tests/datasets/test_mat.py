"""MATLAB readers against written files, and the conventions of the real one."""

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp

from colmap_vg.datasets.mat import read_rotation_mat, read_topology_mat
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3


def test_topology_counts_each_pair_once(tmp_path):
    A = sp.coo_array((np.ones(5), ([0, 1, 2, 0, 3], [1, 0, 1, 3, 3])), shape=(5, 5))
    scipy.io.savemat(tmp_path / "a.mat", {"A": A})
    num_images, edges = read_topology_mat(tmp_path / "a.mat")
    assert num_images == 5
    assert edges.tolist() == [[0, 1], [0, 3], [1, 2]]


def test_bad_files(tmp_path):
    (tmp_path / "t.mat").write_text("not matlab")
    with pytest.raises(DataFileError, match=r"t\.mat"):
        read_topology_mat(tmp_path / "t.mat")
    scipy.io.savemat(tmp_path / "b.mat", {"B": np.eye(3)})
    with pytest.raises(DataFileError, match="no variable A"):
        read_topology_mat(tmp_path / "b.mat")


@pytest.mark.real_data
def test_real_rotations_fit_their_truth_in_our_order(data_folder):
    graph = read_rotation_mat(data_folder / "view_graphs" / "rotations" / "ellis_island.mat")
    assert (graph.num_images, int(graph.known.sum())) == (247, 227)
    i, j = graph.edges[graph.known[graph.edges].all(axis=1)].T
    relative = graph.cam2_from_cam1_rotations[graph.known[graph.edges].all(axis=1)]
    R = graph.cam_from_world_rotations
    error = np.degrees(so3.angle(relative @ R[i] @ np.swapaxes(R[j], 1, 2)))
    assert np.median(error) == pytest.approx(2.9, abs=0.1)
    assert np.mean(error > 30) == pytest.approx(0.123, abs=0.005)
