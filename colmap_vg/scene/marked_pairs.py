"""A user's marks on the pairs of a viewing graph: pairs not to be used, and pairs that no filter may drop."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph

BoolArray = NDArray[np.bool_]


def with_marked_pairs(graph: ViewGraph, excluded: BoolArray, trusted: BoolArray) -> ViewGraph:
    """Mark pairs of a graph as excluded and as trusted.

    Parameters
    ----------
    graph : ViewGraph
        Without marks.
    excluded : (m,) bool array
    trusted : (m,) bool array
        Those that are excluded, too, are excluded. Trusted pairs are used even if nothing confirms their fundamental
        matrix.

    Returns
    -------
    ViewGraph
    """
    verdicts = graph.read_verdicts
    if verdicts is None:
        verdicts = np.full(graph.num_edges, str(EdgeVerdict.KEPT))
    trusted = trusted & ~excluded
    verdicts = np.where(excluded, str(EdgeVerdict.EXCLUDED), verdicts)
    verdicts = np.where(trusted & (verdicts == EdgeVerdict.UNCALIBRATED), str(EdgeVerdict.KEPT), verdicts)
    return replace(graph, read_verdicts=verdicts, trusted=trusted if trusted.any() else None)
