"""Rotations that most verified matches agree with: several starts, the one of largest consensus, then precision.

Averaging with a robust loss finds the valley that it starts in. Where nearly half of the edges are false and agree
among themselves, that valley is often a fold; what tells the right one is how many edges agree with it, each by the
odds that it is right. These are learned: edges with more inliers are right more often, how much more depends on the
scene. Information says how precise an edge is if it is right: it refines, inside the consensus that was chosen.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.rotations.alternatives import nearest_alternative
from colmap_vg.rotations.cycles import closing_shares, rival_share
from colmap_vg.rotations.refinement import AGREEMENT_DEG, capped_likelihoods, refine_rotations
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.rotations.spanning_tree import spanning_tree
from colmap_vg.rotations.votes import rotations_by_votes
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CLEAR_CONSENSUS = 0.97
"""Consensus from which on no other start is tried: on graphs of photographs it was above 0.98 wherever few pairs were
false."""
MAX_RIVAL_SHARE = 0.02
"""Or of the triangles of edges that disagree, those that close (`rival_share`), up to which no other start is tried. On
graphs of 1DSfM with 30 % false edges at random it was below 0.01, with 15 % that agree in groups above 0.6, and on
graphs of objects that repeat themselves mostly above 0.05."""
SKELETON_EDGES = 6
"""Edges of each image, its heaviest, by which a first candidate is chosen to learn from. What repeats makes many pairs,
and weaker ones: of 100 graphs of objects that repeat themselves the consensus of all edges chose right in 90, that of
the heaviest in 98; but it is a sample of the evidence only, and where likelihoods tell nothing, a poor one."""
BACKBONE_EDGES = 2
NUM_GROUPS = 10
"""Of edges with like likelihoods, each as many, whose shares of agreement with the first candidate are learned."""
TELLING_LOG_ODDS = 3.0
"""From the least to the most likely edges: where likelihoods tell so much, only each image's heaviest edges count."""
VOTES = ((20, 4.0), (20, 10.0), (20, 1.0), (10, 4.0), (6, 4.0))
"""Starts by votes: how many of each image's heaviest edges vote, and up to which likelihood over the median's."""
RANDOM_VOTES, NUM_RANDOM_STARTS, RANDOM_SPREAD = (20, 8), 8, 0.5
"""Starts by votes whose weights are multiplied at random, log-normally, in turn of so many edges an image."""
MAX_EDGES_OF_STARTS = 60_000
"""Edges of all random starts together, at most. Fewer starts than these find the same solution on large graphs, but not
its rivals: on graphs of 1DSfM with false edges in groups, a third of the doubts were lost."""
AVERAGED_EDGES = 40
"""Edges of each image, its heaviest, by which candidates are averaged; the winner by all."""
MIN_CLOSING_SHARE = 0.01
MAX_NUM_MOVED = 10
"""Images that the nearest other solution may be away; on larger graphs random starts end in different folds."""
NUM_ALIGNMENTS = 32
SAME_DEG, SAME_SHARE = 15.0, 0.95
"""Two solutions are the same where so large a share of the images is turned by no more than this between them."""


@dataclass(frozen=True, eq=False)
class ConsensusRotations:
    """The rotations that won, and how clearly.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    lead : float
        Over the nearest solution that is another one, as a share of the weight of the edges that agree with just one of
        the two; by likelihoods or by learned odds, whichever is larger. 1 where there was no other, or none was looked
        for.
    rival_images : (n,) bool array
        Images that the nearest other solution turns otherwise.
    rivals : tuple of (n, 3, 3) arrays
        That solution, and the one that each image's two heaviest edges make, where these are others than the winner.
    log : tuple of LogEntry
        Of the averaging that refined the winner.
    """

    cam_from_world_rotations: Array
    lead: float
    rival_images: BoolArray
    rivals: tuple[Array, ...]
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
    if not search.is_clear():
        # On graphs of many edges the heaviest are enough to find the valley in.
        search.average_by(AVERAGED_EDGES)
        search.add_backbone()
        for start, l1 in _starts(search, seed):
            search.add(search.averaged(start, l1=l1))
        search.average_by(None)
        search.add(search.averaged(search.ranked()[0], l1=False))
        search.add_alternative(search.ranked()[0])
    best, lead, apart, rivals = search.ranked()
    rotations, log = refine_rotations(num_images, edges, cam2_from_cam1_rotations, likelihoods, weights, best)
    return ConsensusRotations(rotations, lead, apart, rivals, log)


def _starts(search: "_Search", seed: int) -> Iterator[tuple[Array, bool]]:
    """Rotations by votes to average from, and whether the L1 phase is to come first."""
    yield search.votes(*VOTES[0]), False
    closing = search.votes(*VOTES[0], search.closing_shares())
    yield closing, False
    for per_image, cap in VOTES[1:]:
        yield search.votes(per_image, cap), False
    yield closing, True
    if search.agree():
        return
    rng = np.random.default_rng(seed)
    for number in range(min(NUM_RANDOM_STARTS, MAX_EDGES_OF_STARTS // (RANDOM_VOTES[0] * search.num_images))):
        noise = np.exp(RANDOM_SPREAD * rng.standard_normal(len(search.edges)))
        yield search.votes(RANDOM_VOTES[number % len(RANDOM_VOTES)], VOTES[0][1], noise), False


class _Search:
    """Candidates and the edges that agree with each."""

    def __init__(self, num_images: int, edges: IntArray, relative: Array, likelihoods: Array) -> None:
        self.num_images, self.edges, self.relative = num_images, edges, relative
        self._likelihoods = likelihoods / np.median(likelihoods)
        self._capped = capped_likelihoods(likelihoods)
        self._heaviest = cache(self._find_heaviest)
        self._skeleton = self._heaviest(SKELETON_EDGES)
        self._averaged = np.ones(len(edges), dtype=bool)
        self._backbone: Array | None = None
        self._candidates: list[Array] = []
        self._agree: list[BoolArray] = []

    def add(self, rotations: Array) -> None:
        """Take a candidate in."""
        residuals = rotation_residuals(self.edges, self.relative, rotations)
        self._candidates.append(rotations)
        self._agree.append(residuals <= np.radians(AGREEMENT_DEG))

    def add_backbone(self) -> None:
        """Take in the solution that each image's two heaviest edges make.

        What repeats matches many pairs; pairs of neighbours, who see what does not repeat as well, match best.
        """
        self._backbone = self.averaged(self.votes(BACKBONE_EDGES, np.inf), l1=False)
        self.add(self._backbone)

    def add_alternative(self, rotations: Array) -> None:
        """Take in the nearest other solution, where it is few images away."""
        num_moved = int((1.0 - SAME_SHARE) * self.num_images) + 1
        if num_moved <= MAX_NUM_MOVED:
            problem = self.num_images, self.edges, self.relative, self._capped
            self.add(nearest_alternative(*problem, rotations, num_moved))

    def average_by(self, per_image: int | None) -> None:
        """Average candidates from now on by each image's heaviest edges, or by all."""
        self._averaged = np.ones(len(self.edges), dtype=bool) if per_image is None else self._heaviest(per_image)

    def agree(self) -> bool:
        """Whether all candidates but the first are one solution."""
        return not any(_differ(self._candidates[1], other) for other in self._candidates[2:])

    def is_clear(self) -> bool:
        """Whether the first candidate needs no other.

        Nearly all of its edges agree, the heaviest too, or those that disagree do so each in its own way.
        """
        shares = [
            self._capped[among] @ self._agree[0][among] / self._capped[among].sum() for among in (self._skeleton, ...)
        ]
        if min(shares) >= CLEAR_CONSENSUS:
            return True
        among = self._heaviest(AVERAGED_EDGES)
        edges, agree = self.edges[among], self._agree[0][among]
        return rival_share(self.num_images, edges, self.relative[among], self._capped[among], agree) <= MAX_RIVAL_SHARE

    def votes(self, per_image: int, cap: float, factors: Array | float = 1.0) -> Array:
        """Rotations by votes of each image's heaviest edges, their capped likelihoods times factors."""
        voting = self._heaviest(per_image)
        weights = (np.minimum(self._likelihoods, cap) * factors)[voting]
        return rotations_by_votes(self.num_images, self.edges[voting], self.relative[voting], weights)

    def closing_shares(self) -> Array:
        """Of the triangles of edges that vote, above zero; of the others 1."""
        among, shares = self._heaviest(VOTES[0][0]), np.ones(len(self.edges))
        shares[among] = closing_shares(self.num_images, self.edges[among], self.relative[among], self._capped[among])
        return np.maximum(shares, MIN_CLOSING_SHARE)

    def averaged(self, start: Array | None, *, l1: bool) -> Array:
        """Rotations averaged by the capped likelihoods from a start, or from the spanning tree."""
        return average_rotations_robust(
            self.num_images,
            self.edges[self._averaged],
            self.relative[self._averaged],
            self._capped[self._averaged],
            start,
            sigma_deg=AGREEMENT_DEG,
            adapt_sigma=False,
            max_num_l1_iterations=30 if l1 else 0,
            tolerance=1e-3,
        ).cam_from_world_rotations

    def ranked(self) -> tuple[Array, float, BoolArray, tuple[Array, ...]]:
        """The best candidate, its lead over the nearest other solution, where that one differs, and its rivals."""
        if len(self._candidates) == 1:
            return self._candidates[0], 1.0, np.zeros(self.num_images, dtype=bool), ()
        agree = np.array(self._agree, dtype=np.float64)
        of_all = agree @ self._capped / self._capped.sum()
        skeleton = np.where(self._skeleton, self._capped, 0.0)
        first = int(np.argmax(agree @ skeleton))
        odds = learned_log_odds(self._likelihoods, self._agree[first])
        if np.ptp(odds) >= TELLING_LOG_ODDS:
            odds = np.where(self._skeleton, odds, 0.0)
        by_odds = agree @ odds / odds.sum() if odds.any() else of_all
        winner = int(np.lexsort((-of_all, -by_odds))[0])
        best, lead, apart = self._candidates[winner], 1.0, np.zeros(self.num_images, dtype=bool)
        rivals: tuple[Array, ...] = ()
        for row, other in enumerate(self._candidates):
            ahead = max(_lead(weights, agree[winner], agree[row]) for weights in (self._capped, odds))
            if ahead < lead:
                turned = _turned(best, other) > np.radians(SAME_DEG)
                if turned.mean() > 1.0 - SAME_SHARE:
                    lead, apart, rivals = ahead, turned, (other,)
        if self._backbone is not None and all(_differ(self._backbone, other) for other in (best, *rivals)):
            rivals += (self._backbone,)
        return best, lead, apart, rivals

    def _find_heaviest(self, count: int) -> BoolArray:
        """Edges (m,) that are among the heaviest of one of their images, and those that join what these leave apart.

        All edges where they weigh the same.
        """
        weights, num_edges = self._likelihoods, len(self.edges)
        if np.ptp(weights) == 0:
            return np.ones(num_edges, dtype=bool)
        ends, rows = self.edges.T.ravel(), np.tile(np.arange(num_edges), 2)
        order = np.lexsort((rows, -weights[rows], ends))
        rank = np.arange(len(order)) - np.searchsorted(ends[order], np.arange(self.num_images))[ends[order]]
        chosen = np.zeros(num_edges, dtype=bool)
        chosen[rows[order[rank < count]]] = True
        _, tree, _ = spanning_tree(self.num_images, self.edges, weights)
        chosen[tree[tree >= 0]] = True
        return chosen


def _lead(weights: Array, agree: Array, other: Array) -> float:
    """Lead of one solution over another, as a share of the weight that agrees with just one of them."""
    contested = float(weights @ np.abs(agree - other))
    return float(weights @ (agree - other)) / contested if contested > 0 else 0.0


def learned_log_odds(likelihoods: Array, agree: BoolArray) -> Array:
    """Log odds that an edge is right, by the share that agrees with a candidate among edges of like likelihood.

    Parameters
    ----------
    likelihoods : (m,) array
    agree : (m,) bool array

    Returns
    -------
    (m,) array
        Never falling with the likelihood, and 0 where less than half agree.
    """
    from scipy.optimize import isotonic_regression  # a tenth of a second that clear graphs do without

    place = np.searchsorted(np.sort(likelihoods), likelihoods)  # equal likelihoods go together
    group = np.minimum(NUM_GROUPS * place // max(len(place), 1), NUM_GROUPS - 1)
    total, right = np.bincount(group, minlength=NUM_GROUPS), np.bincount(group, agree, NUM_GROUPS)
    share = isotonic_regression((right + 0.5) / (total + 1.0), weights=np.maximum(total, 1e-9)).x[group]
    return np.asarray(np.maximum(np.log(share / (1.0 - share)), 0.0))


def _differ(one: Array, other: Array) -> bool:
    """Whether two solutions are not the same."""
    return bool((_turned(one, other) > np.radians(SAME_DEG)).mean() > 1.0 - SAME_SHARE)


def _turned(one: Array, other: Array) -> Array:
    """Angles (n,) between two solutions' rotations after the turn of the world that most images agree on, radians."""
    turns = np.swapaxes(one, 1, 2) @ other
    tried = turns[np.linspace(0, len(turns) - 1, min(len(turns), NUM_ALIGNMENTS)).astype(int)]
    angles = so3.angle(np.swapaxes(tried, 1, 2)[:, None] @ turns[None])
    return np.asarray(angles[np.argmin(np.median(angles, axis=1))])
