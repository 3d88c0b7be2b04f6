"""Robust rotation averaging from several starts, with the solution of largest weighted consensus.

Robust averaging converges to a local minimum near its start. If nearly half of the edges are false and consistent among
themselves, that minimum is often a folded model. The candidate with the largest consensus is chosen, where each edge is
weighted by the log odds that it is correct, unless another one explains far better which images match
(:mod:`colmap_vg.rotations.near_views`). The log odds are learned: edges with more inliers are correct more often, but
by how much depends on the scene. The information of an edge, its precision if it is correct, is used only in the final
refinement within the chosen consensus.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import quaternions, so3
from colmap_vg.rotations.alternatives import nearest_alternative
from colmap_vg.rotations.cycles import closing_shares, rival_share
from colmap_vg.rotations.near_views import matching_share
from colmap_vg.rotations.refinement import AGREEMENT_DEG, capped_likelihoods, refine_rotations
from colmap_vg.rotations.robust import RobustAveraging
from colmap_vg.rotations.spanning_tree import spanning_tree
from colmap_vg.rotations.votes import rotations_by_votes
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CLEAR_CONSENSUS = 0.97
"""Consensus of the first candidate from which on no other start is tried. On graphs of photographs it was above 0.98
wherever few pairs were false."""
MAX_RIVAL_SHARE = 0.02
"""Share of closing triangles among disagreeing edges (`rival_share`) up to which no other start is tried either. On
graphs of 1DSfM with 30 % false edges at random it was below 0.01, with 15 % false edges consistent in groups above 0.6,
and on graphs of objects that repeat themselves mostly above 0.05."""
SKELETON_EDGES = 6
"""Number of edges per image, the heaviest, whose consensus selects the candidate that log odds are learned from.
Repeated structure causes many but weaker pairs: of 100 graphs of objects that repeat themselves, the consensus of all
edges selected the correct candidate in 90, that of the heaviest edges in 98. It is a subsample only, and a poor one if
likelihoods are not informative."""
BACKBONE_EDGES = 2
"""Number of edges per image, the heaviest, of the backbone solution."""
NUM_GROUPS = 10
"""Number of equally large groups of edges of similar likelihood, for each of which the log odds are learned."""
INFORMATIVE_LOG_ODDS = 3.0
"""Range of the log odds over all edges above which only the heaviest edges of each image count."""
VOTES = ((20, 4.0), (20, 10.0), (20, 1.0), (10, 4.0), (6, 4.0))
"""Starts by votes: number of voting edges per image, the heaviest, and upper limit of their likelihood over the
median."""
RANDOM_VOTES, NUM_RANDOM_STARTS, RANDOM_SPREAD = (20, 8), 8, 0.5
"""Random starts: voting edges per image (alternating), number of starts, and standard deviation of the log-normal
factors on the weights."""
MAX_EDGES_OF_STARTS = 60_000
"""Upper limit of the voting edges of all random starts together. Fewer starts find the same solution on large graphs,
but fewer alternatives: on graphs of 1DSfM with false edges in groups, a third of the doubtful cases were missed."""
AVERAGED_EDGES = 40
"""Number of edges per image, the heaviest, used to average candidates; the winner is averaged over all edges."""
MIN_CLOSING_SHARE = 0.01
"""Lower limit of the closing shares used as factors on the weights of votes."""
MAX_NUM_MOVED = 10
"""Maximum number of images moved to form the nearest alternative; on larger graphs random starts find other folds."""
MIN_MATCHING_SHARE, MATCHING_LEAD, MIN_RELATIVE_CONSENSUS = 0.85, 0.1, 0.8
"""A candidate is preferred to that of largest consensus if at least this share of its near views match
(`matching_share`), if the share is larger by this lead, and if its consensus is at least this share of the largest. On
graphs of objects that repeat themselves the share was 0.87 to 1 for the truth, and mostly 0.3 to 0.8 for solutions
that moved a fifth of the images or more; always below the truth's."""
NUM_ALIGNMENTS = 32
"""Number of images whose rotations are tried to align two solutions."""
SAME_DEG, SAME_SHARE = 15.0, 0.95
"""Two solutions are the same if at least this share of the images differs by no more than this angle, degrees."""


@dataclass(frozen=True, eq=False)
class ConsensusRotations:
    """Rotations chosen by consensus and near views, with their lead over alternative solutions.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    lead : float
        Lead over the closest competing solution, as a share of the weight of the edges that agree with exactly one of
        the two; by likelihoods or by learned log odds, whichever is larger. Negative where near views overrule
        consensus; 1 if there was no other solution, or none was searched for.
    rival_images : (n,) bool array
        Images whose rotation differs in the closest competing solution.
    rivals : tuple of (n, 3, 3) arrays
        cam_from_world rotations of that solution, and of the one from the two heaviest edges of each image, as far as
        they differ from the winner.
    log : tuple of LogEntry
        Log of the averaging that refined the winner.
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
    """Average rotations from several starts and return the solution of largest weighted consensus.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    cam2_from_cam1_rotations : (m, 3, 3) array
    likelihoods : (m,) array
        Positive evidence that each edge is correct, of any scale: its number of inliers.
    weights : (m,) array
        Precisions of the edges' rotations, for the final refinement.
    seed : int
        Random seed of the random starts.

    Returns
    -------
    ConsensusRotations
    """
    search = _Search(num_images, edges, cam2_from_cam1_rotations, likelihoods)
    search.add(search.averaged(None, l1=True))
    if not search.is_clear():
        # On graphs with many edges the heaviest suffice to find the local minima.
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
    """Initial rotations by votes, and whether averaging from them starts with the L1 phase."""
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
    """Candidate rotations, with the edges that agree with each."""

    def __init__(self, num_images: int, edges: IntArray, relative: Array, likelihoods: Array) -> None:
        self.num_images, self.edges, self.relative = num_images, edges, relative
        self._likelihoods = likelihoods / np.median(likelihoods)
        self._capped = capped_likelihoods(likelihoods)
        self._quaternions = quaternions.from_matrices(relative)
        self._heaviest = cache(self._find_heaviest)
        self._skeleton = self._heaviest(SKELETON_EDGES)
        self.average_by(None)
        self._backbone: Array | None = None
        self._candidates: list[Array] = []
        self._agree: list[BoolArray] = []
        self._matching: list[float] = []  # shares of matching near views, of the candidates that were ranked

    def add(self, rotations: Array) -> None:
        """Add a candidate."""
        i, j = self.edges.T
        q = quaternions.from_matrices(rotations)
        turns = quaternions.multiply(q[:, j], quaternions.conjugate(q)[:, i])
        cosine = np.abs(np.einsum("cm,cm->m", turns, self._quaternions))
        self._candidates.append(rotations)
        self._agree.append(cosine >= np.cos(np.radians(0.5 * AGREEMENT_DEG)))

    def add_backbone(self) -> None:
        """Add the solution from the two heaviest edges of each image.

        Repeated structure matches in many pairs, but neighbouring images, which also share unique structure, match
        best.
        """
        self._backbone = self.averaged(self.votes(BACKBONE_EDGES, np.inf), l1=False)
        self.add(self._backbone)

    def add_alternative(self, rotations: Array) -> None:
        """Add the nearest alternative solution if it differs in few enough images."""
        num_moved = int((1.0 - SAME_SHARE) * self.num_images) + 1
        if num_moved <= MAX_NUM_MOVED:
            problem = self.num_images, self.edges, self.relative, self._capped
            self.add(nearest_alternative(*problem, rotations, num_moved))

    def average_by(self, per_image: int | None) -> None:
        """Average further candidates over the heaviest edges of each image, or over all edges."""
        among = np.ones(len(self.edges), dtype=bool) if per_image is None else self._heaviest(per_image)
        self._averaging = RobustAveraging(self.num_images, self.edges[among], self.relative[among], self._capped[among])

    def agree(self) -> bool:
        """Whether all candidates after the first are the same solution."""
        return not any(_differ(self._candidates[1], other) for other in self._candidates[2:])

    def is_clear(self) -> bool:
        """Whether the first candidate is so clear that no other start is needed.

        Nearly all edges and nearly all of the heaviest edges agree with it, or the disagreeing edges have independent
        errors.
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
        """Rotations by votes of the heaviest edges of each image, weighted by capped likelihoods times factors."""
        voting = self._heaviest(per_image)
        weights = (np.minimum(self._likelihoods, cap) * factors)[voting]
        return rotations_by_votes(self.num_images, self.edges[voting], self.relative[voting], weights)

    def closing_shares(self) -> Array:
        """Share of closing triangles of each voting edge, at least `MIN_CLOSING_SHARE`; 1 for other edges."""
        among, shares = self._heaviest(VOTES[0][0]), np.ones(len(self.edges))
        shares[among] = closing_shares(self.num_images, self.edges[among], self.relative[among], self._capped[among])
        return np.maximum(shares, MIN_CLOSING_SHARE)

    def averaged(self, start: Array | None, *, l1: bool) -> Array:
        """Rotations averaged with capped likelihoods as weights, from a start or from the spanning tree."""
        return self._averaging.run(
            start,
            sigma_deg=AGREEMENT_DEG,
            adapt_sigma=False,
            max_num_l1_iterations=30 if l1 else 0,
            max_num_iterations=100,
            tolerance=1e-3,
        ).cam_from_world_rotations

    def ranked(self) -> tuple[Array, float, BoolArray, tuple[Array, ...]]:
        """The best candidate, its lead over the closest competitor, the images where that differs, and its rivals."""
        if len(self._candidates) == 1:
            return self._candidates[0], 1.0, np.zeros(self.num_images, dtype=bool), ()
        agree = np.array(self._agree, dtype=np.float64)
        of_all = agree @ self._capped / self._capped.sum()
        skeleton = np.where(self._skeleton, self._capped, 0.0)
        first = int(np.argmax(agree @ skeleton))
        odds = learned_log_odds(self._likelihoods, self._agree[first])
        if np.ptp(odds) >= INFORMATIVE_LOG_ODDS:
            odds = np.where(self._skeleton, odds, 0.0)
        by_odds = agree @ odds / odds.sum() if odds.any() else of_all
        winner = self._with_its_near_views(int(np.lexsort((-of_all, -by_odds))[0]), by_odds)
        best, lead, apart = self._candidates[winner], 1.0, np.zeros(self.num_images, dtype=bool)
        rivals: tuple[Array, ...] = ()
        for row, other in enumerate(self._candidates):
            ahead = max(_lead(weights, agree[winner], agree[row]) for weights in (self._capped, odds))
            if ahead < lead:
                turned = _rotation_differences(best, other) > np.radians(SAME_DEG)
                if turned.mean() > 1.0 - SAME_SHARE:
                    lead, apart, rivals = ahead, turned, (other,)
        if self._backbone is not None and all(_differ(self._backbone, other) for other in (best, *rivals)):
            rivals += (self._backbone,)
        return best, lead, apart, rivals

    def _with_its_near_views(self, first: int, consensus: Array) -> int:
        """The candidate of largest consensus, or one that explains far better which images match."""
        for row in range(len(self._matching), len(self._candidates)):
            self._matching.append(matching_share(self.edges, self._agree[row], self._candidates[row]))
        shares = self._matching
        eligible = np.where(consensus >= MIN_RELATIVE_CONSENSUS * consensus[first], shares, 0.0)
        best = int(np.argmax(eligible))
        return best if shares[best] >= max(MIN_MATCHING_SHARE, shares[first] + MATCHING_LEAD) else first

    def _find_heaviest(self, count: int) -> BoolArray:
        """Mask (m,) of edges among the `count` heaviest of one of their images, or in the maximum spanning tree.

        All edges if all weights are equal.
        """
        if np.ptp(self._likelihoods) == 0:
            return np.ones(len(self.edges), dtype=bool)
        in_tree, rank = self._tree_and_ranks
        return np.asarray(in_tree | (rank < count))

    @cached_property
    def _tree_and_ranks(self) -> tuple[BoolArray, IntArray]:
        """Whether each edge (m,) is in the maximum spanning tree, and its better rank by weight at its two images."""
        weights, num_edges = self._likelihoods, len(self.edges)
        ends, rows = self.edges.T.ravel(), np.tile(np.arange(num_edges), 2)
        order = np.lexsort((rows, -weights[rows], ends))
        rank = np.empty(2 * num_edges, dtype=np.int64)
        rank[order] = np.arange(len(order)) - np.searchsorted(ends[order], np.arange(self.num_images))[ends[order]]
        in_tree = np.zeros(num_edges, dtype=bool)
        _, tree, _ = spanning_tree(self.num_images, self.edges, weights)
        in_tree[tree[tree >= 0]] = True
        return in_tree, rank.reshape(2, -1).min(axis=0)


def _lead(weights: Array, agree: Array, other: Array) -> float:
    """Lead of one solution over another, as a share of the weight that agrees with exactly one of them."""
    contested = float(weights @ np.abs(agree - other))
    return float(weights @ (agree - other)) / contested if contested > 0 else 0.0


def learned_log_odds(likelihoods: Array, agree: BoolArray) -> Array:
    """Log odds that each edge is correct, from the agreement of edges of similar likelihood with a candidate.

    Parameters
    ----------
    likelihoods : (m,) array
    agree : (m,) bool array
        Edges that agree with the candidate.

    Returns
    -------
    (m,) array
        Non-decreasing in the likelihood; 0 where less than half of the edges agree.
    """
    place = np.searchsorted(np.sort(likelihoods), likelihoods)  # equal likelihoods go together
    group = np.minimum(NUM_GROUPS * place // max(len(place), 1), NUM_GROUPS - 1)
    total, right = np.bincount(group, minlength=NUM_GROUPS), np.bincount(group, agree, NUM_GROUPS)
    share = _never_falling((right + 0.5) / (total + 1.0), np.maximum(total, 1e-9))[group]
    return np.asarray(np.maximum(np.log(share / (1.0 - share)), 0.0))


def _never_falling(values: Array, weights: Array) -> Array:
    """Non-decreasing values (k,) closest to given ones in weighted least squares, by pooling adjacent violators.

    As ``scipy.optimize.isotonic_regression``, whose import takes 0.2 s.
    """
    pools: list[tuple[float, float, int]] = []
    for value, weight in zip(values.tolist(), weights.tolist(), strict=True):
        size = 1
        while pools and pools[-1][0] >= value:
            before, its_weight, its_size = pools.pop()
            value = (value * weight + before * its_weight) / (weight + its_weight)
            weight, size = weight + its_weight, size + its_size
        pools.append((value, weight, size))
    return np.repeat([value for value, _, _ in pools], [size for _, _, size in pools])


def _differ(one: Array, other: Array) -> bool:
    """Whether two solutions differ in more images than `SAME_SHARE` allows."""
    return bool((_rotation_differences(one, other) > np.radians(SAME_DEG)).mean() > 1.0 - SAME_SHARE)


def _rotation_differences(one: Array, other: Array) -> Array:
    """Angles (n,) between the rotations of two solutions after aligning their world frames robustly, radians."""
    turns = np.swapaxes(one, 1, 2) @ other
    tried = turns[np.linspace(0, len(turns) - 1, min(len(turns), NUM_ALIGNMENTS)).astype(int)]
    angles = so3.angle(np.swapaxes(tried, 1, 2)[:, None] @ turns[None])
    return np.asarray(angles[np.argmin(np.median(angles, axis=1))])
