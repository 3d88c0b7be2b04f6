"""Simulate cameras and noisy edges on the adjacency of real image collections, with its degrees, leaves and bridges.

Linked images are close to each other: the images are ordered by the Fiedler vector of the adjacency's normalised
Laplacian, and placed along that order. The noise of an edge increases as its baseline and its number of matches
decrease.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import SyntheticScene, look_at

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

Layout = Literal["street", "ring", "clusters", "collinear"]
MEDIAN_INLIERS = 80.0
"""Median number of matches of an edge; the distribution is log-normal, as in real databases."""
MIN_STATED_SIGMA_DEG = 1e-3
"""Minimum standard deviation in the graph's information matrices, degrees; exact edges would have infinite ones."""


@dataclass(frozen=True)
class TopologyNoise:
    """Noise of the edges of a simulated viewing graph.

    Attributes
    ----------
    rotation_deg, direction_deg : float
        Standard deviation in each tangent axis of an edge with median baseline and median matches, degrees.
    baseline_power : float
        Direction noise is proportional to ``(median baseline / baseline) ** baseline_power``; two-view geometry at
        fixed depth has a power of 1.
    max_direction_deg : float
        Maximum standard deviation of directions, degrees.
    match_spread : float
        Standard deviation of the logarithm of the number of matches; noise is inversely proportional to its square
        root.
    outlier_share : float
        Share of edges with a random relative pose, 0 to 1.
    false_cluster_share : float
        Share of edges of repeated structure, 0 to 1: between two groups of images, wrong by one common rigid motion.
    """

    rotation_deg: float = 0.5
    direction_deg: float = 2.0
    baseline_power: float = 1.0
    max_direction_deg: float = 20.0
    match_spread: float = 0.8
    outlier_share: float = 0.0
    false_cluster_share: float = 0.0


def scene_on_topology(
    num_images: int,
    edges: IntArray,
    *,
    layout: Layout = "street",
    noise: TopologyNoise | None = None,
    seed: int = 0,
) -> SyntheticScene:
    """Simulate a scene with a given adjacency.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        For instance of a 1DSfM set, from `colmap_vg.datasets.mat.read_topology_mat`.
    layout : "street", "ring", "clusters" or "collinear"
        ``clusters`` has groups far from each other, and so short and long baselines; ``collinear`` has sequences of
        cameras on lines.
    noise : TopologyNoise, optional
    seed : int

    Returns
    -------
    SyntheticScene
        `outlier` marks random outliers and edges of false clusters. The graph's `edge_information` is that of the
        simulated noise, also for outliers.

    Raises
    ------
    OptionError
        The layout is unknown or a share is outside 0 to 1.
    """
    noise = noise or TopologyNoise()
    if layout not in get_args(Layout):
        raise OptionError(f"layout is {layout!r}; choose one of {', '.join(get_args(Layout))}")
    if not (0 <= noise.outlier_share <= 1 and 0 <= noise.false_cluster_share <= 1):
        raise OptionError("outlier_share and false_cluster_share must lie between 0 and 1")
    rng = np.random.default_rng(seed)
    along = adjacency_order(num_images, edges)
    p = _centers(along, layout, rng)
    targets = p + normalized(
        np.stack([0.3 * rng.standard_normal(num_images), np.ones(num_images), 0.1 * rng.standard_normal(num_images)], 1)
    )
    R = so3.exp(0.3 * rng.standard_normal((num_images, 3))) @ look_at(p, targets)
    return _measured(R, p, edges, noise, rng)


def adjacency_order(num_images: int, edges: IntArray) -> Array:
    """Rank of each image along the Fiedler vector of the normalised Laplacian, scaled to [0, 1), (n,)."""
    A = sp.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(num_images, num_images)).tocsr()
    A = sp.csr_array(A + A.T)
    scale = sp.diags_array(1.0 / np.sqrt(np.maximum(A.sum(axis=1), 1.0)))
    start = np.cos(np.arange(num_images) * 0.7)  # an arbitrary fixed vector, for identical results
    _, vectors = spla.eigsh(sp.csr_array(scale @ A @ scale), k=2, which="LA", v0=start, tol=1e-6)
    order = np.argsort(scale @ vectors[:, 0], kind="stable")
    rank = np.empty(num_images)
    rank[order] = np.arange(num_images) / num_images
    return rank


def _centers(along: Array, layout: Layout, rng: np.random.Generator) -> Array:
    """Positions (n, 3); one unit is the mean distance along the layout."""
    n = len(along)
    s = n * along
    jitter = rng.standard_normal((n, 3)) * np.array([0.5, 1.5, 0.4])
    if layout == "street":
        bend = 0.1 * n * np.sin(2.0 * np.pi * along)
        return np.asarray(np.stack([s, bend, np.zeros(n)], axis=1) + jitter)
    if layout == "ring":
        turn = 2.0 * np.pi * along
        radius = n / (2.0 * np.pi)
        return np.asarray(radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1) + jitter)
    if layout == "clusters":
        size = max(10, n // 12)
        group = (s // size).astype(int)
        middle = rng.standard_normal((group.max() + 1, 3)) * np.array([1.0, 1.0, 0.2])
        middle = np.cumsum(size * normalized(middle), axis=0)
        return np.asarray(middle[group] + jitter * np.array([4.0, 1.5, 1.0]))
    run = (s // 8).astype(int)  # eight cameras to a line
    heading = normalized(rng.standard_normal((run.max() + 1, 3)) * np.array([1.0, 1.0, 0.1]))
    corner = np.concatenate([np.zeros((1, 3)), np.cumsum(8.0 * heading, axis=0)[:-1]])
    return np.asarray(corner[run] + (s - 8.0 * run)[:, None] * heading[run] + 0.01 * rng.standard_normal((n, 3)))


def _measured(R: Array, p: Array, edges: IntArray, noise: TopologyNoise, rng: np.random.Generator) -> SyntheticScene:
    """Make edges with noise that depends on baseline and matches, random outliers and coherent false clusters."""
    i, j = edges[:, 0], edges[:, 1]
    m = len(edges)
    baseline = np.linalg.norm(p[j] - p[i], axis=1)
    inliers = np.maximum(np.round(MEDIAN_INLIERS * np.exp(noise.match_spread * rng.standard_normal(m))), 16).astype(
        np.int64
    )
    fewness = np.sqrt(MEDIAN_INLIERS / inliers)
    shortness = (np.median(baseline) / np.maximum(baseline, 1e-9)) ** noise.baseline_power
    rotation_sigma = np.radians(noise.rotation_deg) * fewness
    direction_sigma = np.radians(np.minimum(noise.direction_deg * fewness * shortness, noise.max_direction_deg))
    relative = R[j] @ np.swapaxes(R[i], 1, 2)
    direction = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    false = _false_clusters(edges, len(p), round(noise.false_cluster_share * m), rng)
    if false.any():
        # The second camera of each such pair is moved by one common rigid motion.
        turn = so3.random(1, rng)[0]
        shift = 0.3 * np.linalg.norm(p.max(axis=0) - p.min(axis=0)) * normalized(rng.standard_normal(3))
        R_false, p_false = R[j[false]] @ turn.T, p[j[false]] @ turn.T + shift
        relative[false] = R_false @ np.swapaxes(R[i[false]], 1, 2)
        direction[false] = normalized(np.einsum("kab,kb->ka", R[i[false]], p_false - p[i[false]]))
    relative = so3.exp(rotation_sigma[:, None] * rng.standard_normal((m, 3))) @ relative
    turned = so3.exp(direction_sigma[:, None] * rng.standard_normal((m, 3)))
    direction = np.einsum("kab,kb->ka", turned, direction)
    random = np.zeros(m, dtype=bool)
    random[rng.permutation(m)[: round(noise.outlier_share * m)]] = True
    random &= ~false
    relative[random] = so3.random(int(random.sum()), rng)
    direction[random] = normalized(rng.standard_normal((int(random.sum()), 3)))
    least = np.radians(MIN_STATED_SIGMA_DEG)
    precisions = np.stack([np.maximum(rotation_sigma, least)] * 3 + [np.maximum(direction_sigma, least)] * 2, 1) ** -2.0
    graph = ViewGraph(
        image_ids=np.arange(1, len(p) + 1),
        edges=edges,
        cam2_from_cam1_rotations=so3.project(relative),
        cam2_in_cam1_directions=normalized(direction),
        num_inliers=inliers,
        edge_information=precisions[:, :, None] * np.eye(5),
    )
    return SyntheticScene(graph, R, p, random | false)


def _false_clusters(edges: IntArray, num_images: int, wanted: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mark about the wanted number of edges, all across one cut through the images, (m,)."""
    false = np.zeros(len(edges), dtype=bool)
    if wanted == 0:
        return false
    # Grow a connected group from a random image until enough edges leave it.
    inside = np.zeros(num_images, dtype=bool)
    inside[rng.integers(num_images)] = True
    for _ in range(num_images):
        crossing = inside[edges].sum(axis=1) == 1
        if crossing.sum() >= 2 * wanted or inside.sum() > num_images // 3:
            break
        outside_ends = edges[crossing][~inside[edges[crossing]]]
        if len(outside_ends) == 0:
            break
        inside[np.bincount(outside_ends, minlength=num_images).argmax()] = True
    rows = np.flatnonzero(inside[edges].sum(axis=1) == 1)
    # At most half of the cut is false, so that the majority of the edges across it is true.
    false[rng.permutation(rows)[: min(wanted, len(rows) // 2)]] = True
    return false
