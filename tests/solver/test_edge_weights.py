"""What speaks for an edge: its inliers, planar or not, and the user's word."""

from dataclasses import replace

import numpy as np

from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.solver.edge_weights import TRUSTED_LIKELIHOOD, edge_likelihoods


def test_likelihoods_are_inliers_over_the_median_and_trusted_pairs_count_more():
    graph = ring_scene(10, 4, seed=1).graph
    rows = np.arange(graph.num_edges)
    counted = replace(graph, num_inliers=20 + rows, planar=rows % 2 == 0)
    found = edge_likelihoods(counted, rows)
    assert np.allclose(found, (20 + rows) / np.median(20 + rows))
    trusted = edge_likelihoods(replace(counted, trusted=rows == 3), rows)
    assert trusted[3] == TRUSTED_LIKELIHOOD
    assert np.array_equal(np.delete(trusted, 3), np.delete(found, 3))
    assert (edge_likelihoods(replace(graph, num_inliers=None), rows) == 1.0).all()
