"""What each edge counts: by the precision of its rotation, by its number of inliers, or all the same."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.options import SolveOptions
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

PLANAR_WEIGHT = 1.0 / 3.0
"""Pairs explained by a homography have less certain poses (seen on real databases: up to 12 and 85 degrees wrong)."""
TRUSTED_LIKELIHOOD = 10.0
"""Median edges that one counts for which the user trusts."""
MODEL_SIGMA = 1e-3
"""Radians; what the lens model and correlated keypoints leave in a relative rotation however many matches it has."""


def edge_weights(graph: ViewGraph, edge_rows: IntArray, options: SolveOptions) -> Array:
    """Multipliers of squared residuals of chosen edges.

    By information they are ``1 / (tr(Σ_R) / 3 + s²)`` with the marginal covariance Σ_R of the rotation, for directions
    too: measured on real graphs, positions come out better than with the direction's own covariance, which takes pairs
    with long baselines for certain that are few and far apart.

    Parameters
    ----------
    graph : ViewGraph
    edge_rows : (e,) int array
    options : SolveOptions
        `edge_weights`: "information" means "inliers" where the graph has no information, and "inliers" means "unit"
        where it has no numbers of inliers.

    Returns
    -------
    (e,) array
        Median 1.
    """
    weights = np.ones(len(edge_rows))
    if options.edge_weights == "information" and graph.edge_information is not None:
        # Directions that no match sees get a standard deviation of a radian instead of an infinite one.
        covariance = np.linalg.inv(graph.edge_information[edge_rows] + np.eye(5))
        weights = 1.0 / (np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3.0 + MODEL_SIGMA**2)
    elif options.edge_weights != "unit":
        if graph.num_inliers is not None:
            weights = np.sqrt(np.maximum(graph.num_inliers[edge_rows], 1.0))
        if graph.planar is not None:
            weights = np.where(graph.planar[edge_rows], PLANAR_WEIGHT, 1.0) * weights
    return np.asarray(weights / np.median(weights)) if len(weights) else weights


def edge_likelihoods(graph: ViewGraph, edge_rows: IntArray) -> Array:
    """Evidence that chosen edges are right, however precise: their numbers of inliers.

    Planar pairs count in full: their poses are less precise, but nine in ten of those with 60 to 120 inliers were right
    on an object of whose other pairs with as many only one in thirty was.

    Parameters
    ----------
    graph : ViewGraph
    edge_rows : (e,) int array

    Returns
    -------
    (e,) array
        Positive, median 1; all 1 where the graph has no numbers of inliers. Edges that the user trusts count as ten
        median ones at least.
    """
    likelihoods = np.ones(len(edge_rows))
    if graph.num_inliers is not None:
        likelihoods = np.maximum(graph.num_inliers[edge_rows], 1.0)
    if len(likelihoods):
        likelihoods = likelihoods / np.median(likelihoods)
    if graph.trusted is not None:
        likelihoods = np.where(graph.trusted[edge_rows], np.maximum(likelihoods, TRUSTED_LIKELIHOOD), likelihoods)
    return np.asarray(likelihoods)
