"""Rotations with which most verified matches agree: several starts, the one of largest consensus, then precision.

Averaging with a robust loss finds the valley that it starts in. Where nearly half of the edges are false and agree
among themselves, that valley is often a fold; what tells the right one is how many inlier matches agree with it.
Numbers of inliers say how likely an edge is right, information says how precise it is if it is right: the first
chooses, the second refines, inside the consensus that was chosen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.edge_residuals import rotation_residuals
from colmap_vg.geometry import so3
from colmap_vg.rotations.cycles import closing_shares
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.rotations.spanning_tree import spanning_tree
from colmap_vg.rotations.votes import rotations_by_votes
from colmap_vg.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

AGREEMENT_DEG = 5.0
"""A pair within this of the averaged rotations agrees."""
CLEAR_CONSENSUS = 0.97
"""Share of agreeing matches from which on no other start is tried: on graphs of photographs it was above 0.98 wherever
few pairs were false."""
MAX_WEIGHT = 10.0
"""Inliers of one edge, over the median edge's, that count at most: no single pair outvotes a group."""
VOTE_CAPS = (4.0, 10.0, 1.0)
"""Inliers over the median's that count at most in the votes of the first starts."""
VOTES_PER_IMAGE = 20
"""Edges of each image that vote, the heaviest; of weak ones most are false where many are."""
NUM_RANDOM_STARTS, RANDOM_SPREAD, MAX_EDGES_OF_STARTS = 8, 0.5, 200_000
"""Starts by votes whose weights are multiplied at random, log-normally; fewer where all starts' edges together would be
more than that."""
MIN_CLOSING_SHARE = 0.01
MAX_LOSS = 0.002
"""Of the consensus, that refining may cost: a few pairs at the very bound of agreement."""
NUM_ALIGNMENTS = 32
SAME_DEG, SAME_SHARE = 15.0, 0.95
"""Two solutions are the same where so large a share of the images is turned by no more than this between them."""


@dataclass(frozen=True, eq=False)
class ConsensusRotations:
    """The rotations that won, and how clearly.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    consensus : float
        Share of the capped numbers of inliers in edges within `AGREEMENT_DEG`.
    rival_consensus : float
        The same of the best solution that is another one; 0 where none was found, or none was looked for.
    rival_images : (n,) bool array
        Images that the rival turns otherwise.
    log : tuple of LogEntry
        Of the averaging that refined the winner.
    """

    cam_from_world_rotations: Array
    consensus: float
    rival_consensus: float
    rival_images: BoolArray
    log: tuple[LogEntry, ...]


def average_rotations_by_consensus(
    num_images: int,
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    likelihoods: Array,
    weights: Array,
    seed: int = 0,
) -> ConsensusRotations:
    """Rotations of the largest consensus.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Of a connected graph.
    cam2_from_cam1_rotations : (m, 3, 3) array
    likelihoods : (m,) array
        Positive, proportional to the evidence that an edge is right: its number of inliers.
    weights : (m,) array
        Precisions of the edges' rotations, for the last phase.
    seed : int
        Of the random starts.

    Returns
    -------
    ConsensusRotations
    """
    search = _Search(num_images, edges, cam2_from_cam1_rotations, likelihoods)
    search.add(search.averaged(None, l1=True))
    if search.best_consensus < CLEAR_CONSENSUS:
        rng = np.random.default_rng(seed)
        for cap in VOTE_CAPS:
            search.add(search.averaged(search.votes(np.minimum(search.relative_weights, cap)), l1=False))
        start = search.votes(np.minimum(search.relative_weights, VOTE_CAPS[0]) * search.closing_shares())
        search.add(search.averaged(start, l1=False))
        search.add(search.averaged(start, l1=True))
        for _ in range(min(NUM_RANDOM_STARTS, MAX_EDGES_OF_STARTS // max(search.num_voting, 1))):
            noise = np.exp(RANDOM_SPREAD * rng.standard_normal(len(edges)))
            search.add(
                search.averaged(search.votes(np.minimum(search.relative_weights, VOTE_CAPS[0]) * noise), l1=False)
            )
    best, consensus, rival, apart = search.ranked()
    rotations, log = _refined(search, best, consensus, weights)
    return ConsensusRotations(rotations, search.consensus(rotations), rival, apart, log)


class _Search:
    """Candidates and their consensus."""

    def __init__(self, num_images: int, edges: IntArray, relative: Array, likelihoods: Array) -> None:
        self.num_images, self.edges, self.relative = num_images, edges, relative
        self.relative_weights = likelihoods / np.median(likelihoods)
        self.capped = np.minimum(self.relative_weights, MAX_WEIGHT)
        self._voting = _heaviest(num_images, edges, likelihoods, VOTES_PER_IMAGE)
        self.num_voting = int(self._voting.sum())
        self._candidates: list[Array] = []
        self._consensus: list[float] = []

    @property
    def best_consensus(self) -> float:
        """Largest consensus so far."""
        return max(self._consensus)

    def add(self, rotations: Array) -> None:
        """Take a candidate in."""
        self._candidates.append(rotations)
        self._consensus.append(self.consensus(rotations))

    def consensus(self, rotations: Array) -> float:
        """Share of the capped weights in edges that agree with rotations."""
        agree = rotation_residuals(self.edges, self.relative, rotations) <= np.radians(AGREEMENT_DEG)
        return float(self.capped @ agree / self.capped.sum())

    def votes(self, weights: Array) -> Array:
        """Rotations by the votes of each image's heaviest edges."""
        among = weights[self._voting]
        return rotations_by_votes(self.num_images, self.edges[self._voting], self.relative[self._voting], among)

    def closing_shares(self) -> Array:
        """Of the triangles of voting edges, above zero; for edges that do not vote 1."""
        among = self._voting
        shares = np.ones(len(self.edges))
        shares[among] = closing_shares(self.num_images, self.edges[among], self.relative[among], self.capped[among])
        return np.maximum(shares, MIN_CLOSING_SHARE)

    def averaged(self, start: Array | None, *, l1: bool) -> Array:
        """Rotations averaged by the capped weights from a start, or from the spanning tree."""
        return average_rotations_robust(
            self.num_images,
            self.edges,
            self.relative,
            self.capped,
            start,
            sigma_deg=AGREEMENT_DEG,
            adapt_sigma=False,
            max_num_l1_iterations=30 if l1 else 0,
            tolerance=1e-3,
        ).cam_from_world_rotations

    def ranked(self) -> tuple[Array, float, float, BoolArray]:
        """The best candidate, its consensus, that of the best other solution, and where that one differs."""
        order = np.argsort(-np.asarray(self._consensus), kind="stable")
        best = self._candidates[order[0]]
        for other in order[1:]:
            apart = _turned(best, self._candidates[other]) > np.radians(SAME_DEG)
            if apart.mean() > 1.0 - SAME_SHARE:
                return best, self._consensus[order[0]], self._consensus[other], apart
        return best, self._consensus[order[0]], 0.0, np.zeros(self.num_images, dtype=bool)


def _refined(search: _Search, rotations: Array, consensus: float, weights: Array) -> tuple[Array, tuple[LogEntry, ...]]:
    """The rotations after averaging by precision inside their consensus, unless that lowers it."""
    residuals = rotation_residuals(search.edges, search.relative, rotations)
    # The others keep just enough to leave nothing unconnected.
    inside = np.where(residuals <= np.radians(2.0 * AGREEMENT_DEG), weights, 1e-6 * np.median(weights))
    for adapt_sigma in (True, False):
        result = average_rotations_robust(
            search.num_images,
            search.edges,
            search.relative,
            inside,
            rotations,
            sigma_deg=AGREEMENT_DEG,
            adapt_sigma=adapt_sigma,
            max_num_l1_iterations=0,
        )
        if search.consensus(result.cam_from_world_rotations) >= consensus - MAX_LOSS:
            return result.cam_from_world_rotations, result.log
    return rotations, result.log


def _heaviest(num_images: int, edges: IntArray, weights: Array, count: int) -> BoolArray:
    """Edges (m,) that are among the heaviest of one of their images, and those that join what these leave apart."""
    ends, rows = edges.T.ravel(), np.tile(np.arange(len(edges)), 2)
    order = np.lexsort((rows, -weights[rows], ends))
    rank = np.arange(len(order)) - np.searchsorted(ends[order], np.arange(num_images))[ends[order]]
    chosen = np.zeros(len(edges), dtype=bool)
    chosen[rows[order[rank < count]]] = True
    _, tree, _ = spanning_tree(num_images, edges, weights)
    chosen[tree[tree >= 0]] = True
    return chosen


def _turned(one: Array, other: Array) -> Array:
    """Angles (n,) between two solutions' rotations after the turn of the world that most images agree on, radians."""
    turns = np.swapaxes(one, 1, 2) @ other
    tried = turns[np.linspace(0, len(turns) - 1, min(len(turns), NUM_ALIGNMENTS)).astype(int)]
    angles = so3.angle(np.swapaxes(tried, 1, 2)[:, None] @ turns[None])
    return np.asarray(angles[np.argmin(np.median(angles, axis=1))])
