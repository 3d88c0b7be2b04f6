"""Weights of edges, by the precision of their rotations or by their number of inliers."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.options import SolveOptions
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

PLANAR_WEIGHT = 1.0 / 3.0
"""Factor on the weight of pairs explained by a homography, whose poses are less certain (on real databases errors of up
to 12 and 85 degrees were seen)."""
TRUSTED_LIKELIHOOD = 10.0
"""Least likelihood of an edge that the user trusts, in those of the median edge."""
MODEL_SIGMA = 1e-3
"""Standard deviation of a relative rotation due to the lens model and correlated keypoints, radians; it does not
decrease with the number of matches."""


def edge_weights(graph: ViewGraph, edge_rows: IntArray, options: SolveOptions) -> Array:
    """Weights of the squared residuals of chosen edges.

    By information they are ``1 / (tr(Σ_R) / 3 + s²)`` with the marginal covariance Σ_R of the rotation, for directions,
    too: on real graphs positions were better than with the covariance of the direction, which overweights pairs with
    long baselines.

    Parameters
    ----------
    graph : ViewGraph
    edge_rows : (e,) int array
    options : SolveOptions
        `edge_weights`: "information" falls back to "inliers" if the graph has no information, and "inliers" to "unit"
        if it has no numbers of inliers.

    Returns
    -------
    (e,) array
        Median 1.
    """
    weights = np.ones(len(edge_rows))
    if options.edge_weights == "information" and graph.edge_information is not None:
        # Directions that no match constrains get a standard deviation of a radian instead of an infinite one.
        covariance = np.linalg.inv(graph.edge_information[edge_rows] + np.eye(5))
        weights = 1.0 / (np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3.0 + MODEL_SIGMA**2)
    elif options.edge_weights != "unit":
        if graph.num_inliers is not None:
            weights = np.sqrt(np.maximum(graph.num_inliers[edge_rows], 1.0))
        if graph.planar is not None:
            weights = np.where(graph.planar[edge_rows], PLANAR_WEIGHT, 1.0) * weights
    return np.asarray(weights / np.median(weights)) if len(weights) else weights


def edge_likelihoods(graph: ViewGraph, edge_rows: IntArray) -> Array:
    """Evidence that chosen edges are correct, regardless of their precision: their numbers of inliers.

    Planar pairs are not down-weighted: their poses are less precise, but on one object nine in ten of those with 60 to
    120 inliers were correct, and only one in thirty of the other pairs with as many.

    Parameters
    ----------
    graph : ViewGraph
    edge_rows : (e,) int array

    Returns
    -------
    (e,) array
        Positive, median 1; all 1 if the graph has no numbers of inliers. At least 10 for edges that the user trusts.
    """
    likelihoods = np.ones(len(edge_rows))
    if graph.num_inliers is not None:
        likelihoods = np.maximum(graph.num_inliers[edge_rows], 1.0)
    if len(likelihoods):
        likelihoods = likelihoods / np.median(likelihoods)
    if graph.trusted is not None:
        likelihoods = np.where(graph.trusted[edge_rows], np.maximum(likelihoods, TRUSTED_LIKELIHOOD), likelihoods)
    return np.asarray(likelihoods)
