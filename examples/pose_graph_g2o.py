"""Solve a 3-D pose graph from a g2o file: ``python examples/pose_graph_g2o.py sphere2500.g2o``.

Rotations are averaged first (chordal, to the optimum), then positions follow by least squares, then PS refines both.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import lsmr

from colmap_vg import ColmapVgError
from colmap_vg.datasets.g2o import PoseGraph, read_g2o
from colmap_vg.pose_graph.gauss_newton import solve_pose_graph
from colmap_vg.rotations.chordal import average_rotations_chordal


def initial_centers(graph: PoseGraph, rotations: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Positions of least squares at given rotations: p_j - p_i = R_i^T t_ij, the first camera at the origin."""
    n, m, (i, j) = len(graph.ids), len(graph.edges), graph.edges.T
    root = np.sqrt(tau)
    rows = np.tile(np.arange(m), 2)
    B = sp.csr_array((np.concatenate([-root, root]), (rows, np.concatenate([i, j]))), shape=(m, n))[:, 1:]
    moved = root[:, None] * np.einsum("kba,kb->ka", rotations[i], graph.cam2_in_cam1_translations)
    axes = [lsmr(B, moved[:, axis], atol=1e-8, btol=1e-8)[0] for axis in range(3)]
    return np.concatenate([np.zeros((1, 3)), np.stack(axes, axis=1)])


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="g2o file with VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines")
    parser.add_argument("--full_information", action="store_true", help="each edge's 6 x 6 matrix, not two scalars")
    arguments = parser.parse_args()
    try:
        graph = read_g2o(arguments.path)
    except ColmapVgError as error:
        parser.exit(1, f"error: {error}\n")
    begin = time.perf_counter()
    kappa, tau = graph.chordal_weights()
    n = len(graph.ids)
    relative, translations = graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_translations
    R = average_rotations_chordal(n, graph.edges, relative, kappa).cam_from_world_rotations
    start = R, initial_centers(graph, R, tau)
    if arguments.full_information:
        result = solve_pose_graph(n, graph.edges, relative, translations, *start, information=graph.information)
    else:
        result = solve_pose_graph(n, graph.edges, relative, translations, *start, kappa, tau)
    for entry in result.log:
        print(f"{entry.iteration:3d}  cost {entry.cost:.9g}  gradient {entry.change:.1e}")
    word = "converged" if result.converged else "not converged"
    print(f"{n} poses, {len(graph.edges)} edges: {word}, cost {result.cost:.9g}, {time.perf_counter() - begin:.2f} s")


if __name__ == "__main__":
    main()
