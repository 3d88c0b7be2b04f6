"""Lengths of baselines from the tracks that triplets of images share, and the positions that follow from them.

A point that images a, b and c see has one depth in b. By image a it is the baseline's length over the inverse depth
``rho_a`` that the rays give at unit length (see :mod:`colmap_vg.epipolar.depth_agreement`), so that

    log |p_b - p_a| - log |p_b - p_c| = log rho_a - log rho_c;

its median over the tracks ties the lengths of two edges. All logarithms at once are then a robust Laplacian problem on
the graph whose nodes are edges, and positions a linear one: LS2 of Nasiri et al. with lambda known. Directions alone
leave lengths along a line of cameras to the noise; here they are measured.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.depth_agreement import TripletPoses, inverse_depths
from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.linear.reweighted import ReweightedLaplacian
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, MAD_TO_SIGMA, cauchy_weight, geman_mcclure_weight
from colmap_vg.positions.fixed_point import LaplacianSystem, edge_lengths
from colmap_vg.positions.result import centered, spread
from colmap_vg.scene.components import components_by_size
from colmap_vg.two_view.segments import segment_quantiles, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_TRACKS = 10
"""With depths in front of all three cameras; a link of fewer, or of fewer than half of its tracks, is none."""
MEDIAN_TO_MEAN = 1.2533
"""Standard deviation of a median over that of a mean, normal noise."""
LEAST_SIGMA = 0.02
"""Added to a link's noise, squared: what its rotations and directions have wrong is the same for all its tracks."""
MAX_FIRM_SIGMA = 0.1
"""Of a logarithm: a ratio that noise may have wrong by more than a tenth holds no position."""
NUM_L1_TURNS, NUM_CAUCHY_TURNS, LENGTH_TOLERANCE = 8, 22, 1e-4
RESIDUAL_SCALES = (2.0, 0.5, 0.2, 0.1)
"""Geman-McClure scales of positions' residuals in turn, shares of the edge's length."""
TURNS_PER_SCALE = 3


@dataclass(frozen=True, eq=False)
class LengthLinks:
    """Differences of logarithms of edges' lengths.

    Attributes
    ----------
    edges : (q, 2) int64 array
    log_ratios : (q,) array
        Logarithm of the first edge's length over the second's.
    sigmas : (q,) array
        Standard deviations of these by the scatter of their tracks.
    """

    edges: IntArray
    log_ratios: Array
    sigmas: Array

    @property
    def firm(self) -> BoolArray:
        """Links whose noise lets them hold positions, (q,)."""
        return np.asarray(np.hypot(self.sigmas, LEAST_SIGMA) <= MAX_FIRM_SIGMA)


def length_links(problem: EpipolarProblem, relative_rotations: Array, directions: Array) -> LengthLinks:
    """Ratios of the lengths of edges that meet in an image, by the depths of the tracks that they share.

    Parameters
    ----------
    problem : EpipolarProblem
    relative_rotations : (m, 3, 3) array
        cam2_from_cam1 of its edges.
    directions : (m, 3) array
        Camera 2's centre in camera 1's frame, unit.

    Returns
    -------
    LengthLinks
        None for edges without triplets.
    """
    triplets = problem.triplets
    if triplets is None:
        return LengthLinks(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))
    rotations, baselines = [], []
    for side, other in ((0, 0), (1, 2)):
        rows = triplets.edges[:, side]
        R, d = relative_rotations[rows], directions[rows]
        to_middle = (problem.edges[rows, 0] == triplets.images[:, other])[:, None]
        rotations.append(np.where(to_middle[:, :, None], R, np.swapaxes(R, 1, 2)))
        baselines.append(np.where(to_middle, np.einsum("kab,kb->ka", R, d), -d))
    rays = problem.triplet_rays(triplets, np.zeros(len(problem.focal_lengths)))
    by_a, by_c = inverse_depths(rays, TripletPoses(np.stack(rotations), np.stack(baselines)))
    front = (by_a > 0) & (by_c > 0)
    offsets = segment_subset(triplets.offsets, front)
    ratios, count = np.log(by_a[front] / by_c[front]), np.diff(offsets)
    median = segment_quantiles(offsets, ratios)
    scatter = MAD_TO_SIGMA * segment_quantiles(offsets, np.abs(ratios - np.repeat(median, count)))
    good = (count >= MIN_TRACKS) & (count >= 0.5 * np.diff(triplets.offsets))
    return LengthLinks(
        triplets.edges[good], median[good], MEDIAN_TO_MEAN * scatter[good] / np.sqrt(np.maximum(count[good], 1))
    )


def solve_lengths(num_edges: int, links: LengthLinks) -> Array:
    """Lengths of the edges that links join into the largest group, up to a common factor.

    Parameters
    ----------
    num_edges : int
        m.
    links : LengthLinks

    Returns
    -------
    (m,) array
        NaN for the other edges. Geometric mean 1.
    """
    lengths = np.full(num_edges, np.nan)
    if len(links.edges) == 0:
        return lengths
    first, second = links.edges.T
    largest = components_by_size(num_edges, links.edges) == 0
    used, number = largest[first], np.cumsum(largest) - 1
    first, second, ratios = number[first[used]], number[second[used]], links.log_ratios[used]
    weights = 1.0 / (links.sigmas[used] ** 2 + LEAST_SIGMA**2)
    laplacian = ReweightedLaplacian(int(largest.sum()), np.stack([second, first], axis=1))
    x, reweighted = np.zeros(int(largest.sum())), weights
    for turn in range(NUM_L1_TURNS + NUM_CAUCHY_TURNS):
        new = laplacian.solve(reweighted, laplacian.divergence((reweighted * ratios)[None]))[:, 0]
        change, x = float(np.abs(new - x).max()), new
        whitened = np.abs(x[first] - x[second] - ratios) * np.sqrt(weights)
        if turn < NUM_L1_TURNS:
            reweighted = weights / np.maximum(whitened, 1.0)
            continue
        if change < LENGTH_TOLERANCE:
            break
        scale = EFFICIENT_CAUCHY * max(MAD_TO_SIGMA * float(np.median(whitened)), 1.0)
        reweighted = weights * cauchy_weight((whitened / scale) ** 2)
    lengths[largest] = np.exp(x)
    return lengths


def connects_all(num_images: int, edges: IntArray, known: BoolArray) -> bool:
    """Whether the known ones of the edges (m, 2) join all images."""
    return bool((components_by_size(num_images, edges[known]) == 0).all())


def positions_by_lengths(
    num_images: int, edges: IntArray, directions_world: Array, lengths: Array, start: Array | None = None
) -> Array:
    """Positions whose differences come near ``lambda gamma``, robustly, for lengths known on all or some edges.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    lengths : (m,) array
        NaN where not known.
    start : (n, 3) array, optional
        Positions at any scale, from which edges of unknown length take theirs, anew in each turn. Without it these
        edges are left out, and those of known lengths must join all images.

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
    for sigma in np.repeat(RESIDUAL_SCALES, TURNS_PER_SCALE):
        if p is not None:
            lengths = np.where(known, lengths, edge_lengths(p, edges, spread(p)))
        factor = system.factor(weights / lengths**2)
        p = centered(factor.solve(system.right_side(weights / lengths, directions_world)))
        residual = directions_world - (p[edges[:, 1]] - p[edges[:, 0]]) / lengths[:, None]
        weights = geman_mcclure_weight(np.sum(residual**2, axis=1) / sigma**2)
    return np.asarray(p)
