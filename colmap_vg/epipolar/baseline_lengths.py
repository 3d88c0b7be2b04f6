"""Baseline lengths from tracks shared by image triplets, and positions from directions and lengths.

A point seen in images a, b and c has one depth in b. From image a it is the baseline length over the inverse depth
``rho_a`` that the rays give for a unit baseline (see :mod:`colmap_vg.epipolar.depth_agreement`), so that

    log |p_b - p_a| - log |p_b - p_c| = log rho_a - log rho_c.

The median over the tracks gives the ratio of two edge lengths. All log lengths then solve a robust Laplacian problem on
the graph whose nodes are edges, and the positions a linear one: LS2 of Nasiri et al. with lambda known. Directions
alone do not determine lengths along a line of cameras; here they are measured.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.depth_agreement import TripletPoses, inverse_depths
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.linear.laplacian import LaplacianSystem, ReweightedLaplacian
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, MAD_TO_SIGMA, cauchy_weight, geman_mcclure_weight
from colmap_vg.positions.fixed_point import edge_lengths
from colmap_vg.positions.result import centered, spread
from colmap_vg.scene.components import components_by_size
from colmap_vg.two_view.segments import segment_quantiles, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_TRACKS = 10
"""Minimum number of tracks of a ratio, and at least half of its tracks, with positive depths from both images."""
MEDIAN_TO_MEAN = 1.2533
"""Standard deviation of a median over that of a mean, for normal noise."""
MIN_SIGMA = 0.02
"""Noise of a log ratio from errors of rotations and directions, common to all its tracks; added in quadrature."""
MAX_RELIABLE_SIGMA = 0.1
"""Largest standard deviation of a log ratio that may fix positions."""
NUM_L1_ITERATIONS, NUM_CAUCHY_ITERATIONS, LENGTH_TOLERANCE = 8, 22, 1e-4
"""Reweighting iterations with L1 and Cauchy weights, and change of log lengths at which they end."""
RESIDUAL_SCALES = (2.0, 0.5, 0.2, 0.1)
"""Successive Geman-McClure scales of the residuals of positions, as shares of the edge length."""
ITERATIONS_PER_SCALE = 3
"""Reweighting iterations at each of these scales."""


@dataclass(frozen=True, eq=False)
class BaselineRatios:
    """Measured ratios of the lengths of two edges.

    Attributes
    ----------
    edges : (q, 2) int64 array
        Rows of the two edges.
    log_ratios : (q,) array
        Logarithm of the first edge's length over the second's.
    sigmas : (q,) array
        Standard deviations of the log ratios, from the scatter of their tracks.
    """

    edges: IntArray
    log_ratios: Array
    sigmas: Array

    @property
    def reliable(self) -> BoolArray:
        """Mask (q,) of the ratios that are accurate enough to fix positions."""
        return np.asarray(np.hypot(self.sigmas, MIN_SIGMA) <= MAX_RELIABLE_SIGMA)


def estimate_baseline_ratios(problem: EpipolarProblem, relative_rotations: Array, directions: Array) -> BaselineRatios:
    """Estimate ratios of the lengths of edges that share an image, from the depths of their shared tracks.

    Parameters
    ----------
    problem : EpipolarProblem
    relative_rotations : (m, 3, 3) array
        cam2_from_cam1 rotations of its edges.
    directions : (m, 3) array
        Unit directions of camera 2's centre in camera 1's frame.

    Returns
    -------
    BaselineRatios
        Edges without triplets have none.
    """
    triplets = problem.triplets
    if triplets is None:
        return BaselineRatios(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))
    rotations, baselines = [], []
    for side, other in ((0, 0), (1, 2)):
        rows = triplets.edges[:, side]
        R, d = relative_rotations[rows], directions[rows]
        to_middle = (problem.edges[rows, 0] == triplets.images[:, other])[:, None]
        rotations.append(np.where(to_middle[:, :, None], R, np.swapaxes(R, 1, 2)))
        baselines.append(np.where(to_middle, np.einsum("kab,kb->ka", R, d), -d))
    rays = problem.triplet_rays(triplets, Lenses(np.zeros(len(problem.focal_lengths))))
    by_a, by_c = inverse_depths(rays, TripletPoses(np.stack(rotations), np.stack(baselines)))
    front = (by_a > 0) & (by_c > 0)
    offsets = segment_subset(triplets.offsets, front)
    ratios, count = np.log(by_a[front] / by_c[front]), np.diff(offsets)
    median = segment_quantiles(offsets, ratios)
    scatter = MAD_TO_SIGMA * segment_quantiles(offsets, np.abs(ratios - np.repeat(median, count)))
    good = (count >= MIN_TRACKS) & (count >= 0.5 * np.diff(triplets.offsets))
    return BaselineRatios(
        triplets.edges[good], median[good], MEDIAN_TO_MEAN * scatter[good] / np.sqrt(np.maximum(count[good], 1))
    )


def solve_lengths(num_edges: int, ratios: BaselineRatios) -> Array:
    """Solve for the lengths of the largest set of edges that ratios connect, up to a common factor.

    Parameters
    ----------
    num_edges : int
        m.
    ratios : BaselineRatios

    Returns
    -------
    (m,) array
        Geometric mean 1; NaN for the other edges.
    """
    lengths = np.full(num_edges, np.nan)
    if len(ratios.edges) == 0:
        return lengths
    first, second = ratios.edges.T
    largest = components_by_size(num_edges, ratios.edges) == 0
    used, number = largest[first], np.cumsum(largest) - 1
    first, second, log_ratios = number[first[used]], number[second[used]], ratios.log_ratios[used]
    weights = 1.0 / (ratios.sigmas[used] ** 2 + MIN_SIGMA**2)
    laplacian = ReweightedLaplacian(int(largest.sum()), np.stack([second, first], axis=1))
    x, reweighted = np.zeros(int(largest.sum())), weights
    for iteration in range(NUM_L1_ITERATIONS + NUM_CAUCHY_ITERATIONS):
        new = laplacian.solve(reweighted, laplacian.divergence((reweighted * log_ratios)[None]))[:, 0]
        change, x = float(np.abs(new - x).max()), new
        whitened = np.abs(x[first] - x[second] - log_ratios) * np.sqrt(weights)
        if iteration < NUM_L1_ITERATIONS:
            reweighted = weights / np.maximum(whitened, 1.0)
            continue
        if change < LENGTH_TOLERANCE:
            break
        scale = EFFICIENT_CAUCHY * max(MAD_TO_SIGMA * float(np.median(whitened)), 1.0)
        reweighted = weights * cauchy_weight((whitened / scale) ** 2)
    lengths[largest] = np.exp(x)
    return lengths


def connects_all(num_images: int, edges: IntArray, known: BoolArray) -> bool:
    """Whether those edges (m, 2) that the mask `known` (m,) marks connect all images."""
    return bool((components_by_size(num_images, edges[known]) == 0).all())


def positions_by_lengths(
    num_images: int, edges: IntArray, directions_world: Array, lengths: Array, start: Array | None = None
) -> Array:
    """Solve robustly for positions whose differences are close to ``lambda gamma``, with lengths of all or some edges.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    lengths : (m,) array
        NaN where unknown.
    start : (n, 3) array, optional
        Initial positions of any scale. Edges of unknown length take their length from the current positions in each
        iteration. Without them these edges are ignored, and the others must connect all images.

    Returns
    -------
    (n, 3) array
        Centroid 0.
    """
    known = np.isfinite(lengths)
    p = None
    if start is None:
        edges, directions_world, lengths = edges[known], directions_world[known], lengths[known]
        known = known[known]
    else:
        own = edge_lengths(start, edges, spread(start))
        scale = float(np.median(lengths[known] / own[known])) if known.any() else 1.0
        p = scale * start
    system, weights = LaplacianSystem(num_images, edges), np.ones(len(edges))
    for sigma in np.repeat(RESIDUAL_SCALES, ITERATIONS_PER_SCALE):
        if p is not None:
            lengths = np.where(known, lengths, edge_lengths(p, edges, spread(p)))
        factor = system.factor(weights / lengths**2)
        p = centered(factor.solve(system.right_side(weights / lengths, directions_world)))
        residual = directions_world - (p[edges[:, 1]] - p[edges[:, 0]]) / lengths[:, None]
        weights = geman_mcclure_weight(np.sum(residual**2, axis=1) / sigma**2)
    return np.asarray(p)
