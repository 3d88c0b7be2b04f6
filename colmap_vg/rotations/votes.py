"""Initial absolute rotations by agglomerative clustering, where the edges between clusters vote on their alignment.

A spanning tree depends on every one of its edges. Here all edges between two clusters of images vote on the rotation
that aligns them, and the pair of clusters whose vote has the largest lead is merged first. An edge decides alone only
if no other edge connects its clusters, so a false edge, however strong, is outvoted once clusters have formed.
"""

from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.events import report_progress
from colmap_vg.geometry import quaternions
from colmap_vg.rotations.problem import checked_problem

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

VOTES_PER_BATCH = 16
"""Number of votes counted together, since array operations on a single one are mostly overhead."""
AGREEMENT_DEG = 8.0
"""Largest angle between two rotations that agree, degrees: noise of weak pairs plus drift inside clusters."""
NUM_HYPOTHESES = 12
"""Number of edges between two clusters, the heaviest, whose rotations are hypotheses of the vote."""


def rotations_by_votes(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    weights: ArrayLike | None = None,
) -> Array:
    """Rotations from merging clusters of images by weighted majority votes until one cluster is left.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array, optional
        Weight of each edge's vote. Default: all one. Edges of weight zero are ignored.

    Returns
    -------
    (n, 3, 3) array
        cam_from_world rotations.

    Raises
    ------
    GraphError
        The graph is malformed or disconnected.
    """
    edges, relative, w = checked_problem(num_images, edges, cam2_from_cam1_rotations, weights)
    if num_images == 1:
        return np.eye(3)[None]
    # Heaviest first, so that the rows of a vote's heaviest edges are its smallest.
    voting = np.argsort(-w, kind="stable")[: np.count_nonzero(w)]
    clusters = _Clusters(num_images, edges[voting], quaternions.from_matrices(relative[voting]), w[voting])
    for _ in range(num_images - 1):
        report_progress("rotations")
        clusters.merge_best()
    return quaternions.to_matrices(clusters.absolute)


class _Clusters:
    """Clusters of images, each with a frame of its own, and a vote for every two clusters that edges connect.

    Votes are counted lazily: a stale one has an upper bound of its lead and is recounted only when that is the largest.
    """

    def __init__(self, num_images: int, edges: IntArray, relative: Array, weights: Array) -> None:
        self.absolute = np.zeros((4, num_images))
        self.absolute[3] = 1.0
        self._i, self._j = np.ascontiguousarray(edges.T)
        self._relative, self._weights = relative, weights
        self._cluster = np.arange(num_images)
        self._images_of = np.split(np.arange(num_images), num_images)
        low, high = np.minimum(self._i, self._j), np.maximum(self._i, self._j)
        pairs, row = np.unique(low * num_images + high, return_inverse=True)
        by_vote = np.argsort(row, kind="stable")
        ends = np.cumsum(np.bincount(row)).tolist()
        # Of each vote the rows of its edges, in pieces as they were before clusters merged.
        self._voters = [[by_vote[start:end]] for start, end in zip([0, *ends], ends, strict=False)]
        self._clusters_of = np.stack([pairs // num_images, pairs % num_images], axis=1).tolist()
        self._vote_with: list[dict[int, int]] = [{} for _ in range(num_images)]
        for vote, (a, b) in enumerate(self._clusters_of):
            self._vote_with[a][b] = self._vote_with[b][a] = vote
        # Leads of votes; upper bounds where a vote is not fresh.
        self._total = np.bincount(row, weights)
        self._lead = self._total.copy()
        self._fresh = np.zeros(len(pairs), dtype=bool)
        self._turn = np.zeros((4, len(pairs)))
        self._count(np.arange(len(pairs)))

    def merge_best(self) -> None:
        """Merge the two clusters whose vote has the largest lead."""
        best = int(np.argmax(self._lead))
        while not self._fresh[best]:
            self._count(self._votes_to_recount(best))
            best = int(np.argmax(self._lead))
        into, moved = self._clusters_of[best]
        turn = self._turn[:, best : best + 1]
        if len(self._images_of[into]) < len(self._images_of[moved]):
            into, moved, turn = moved, into, quaternions.conjugate(turn)
        images = self._images_of[moved]
        self.absolute[:, images] = quaternions.multiply(self.absolute[:, images], turn)
        self._cluster[images] = into
        self._images_of[into] = np.concatenate([self._images_of[into], images])
        self._lead[best] = -np.inf
        own, joining = self._vote_with[into], self._vote_with[moved]
        del own[moved], joining[into]
        both, gone = [], []
        for other, vote in joining.items():
            del self._vote_with[other][moved]
            standing = own.get(other)
            if standing is None:
                own[other] = self._vote_with[other][into] = vote
                self._clusters_of[vote] = [into, other]
            else:
                self._voters[standing] += self._voters[vote]
                both.append(standing)
                gone.append(vote)
        self._total[both] += self._total[gone]
        self._lead[both] += self._total[gone]
        self._lead[gone] = -np.inf
        self._fresh[[*joining.values(), *both]] = False

    def _votes_to_recount(self, best: int) -> IntArray:
        """Votes to recount: the best, and stale ones whose bounds are more than half of its bound."""
        near = np.flatnonzero(~self._fresh & (self._lead >= 0.5 * self._lead[best]))
        if len(near) > VOTES_PER_BATCH:
            near = near[np.argpartition(-self._lead[near], VOTES_PER_BATCH - 1)[:VOTES_PER_BATCH]]
        return near

    def _count(self, votes: IntArray) -> None:
        """Recount votes."""
        pieces = [self._voters[vote] for vote in votes.tolist()]
        sizes = np.array([sum(map(len, each)) for each in pieces])
        run = np.repeat(np.arange(len(votes)), sizes)
        first = run * len(self._weights)
        rows = np.sort(first + np.concatenate(list(chain.from_iterable(pieces)))) - first
        i, j, w = self._i[rows], self._j[rows], self._weights[rows]
        # R_ij = R_j Q R_i^T, where Q rotates the cluster of the second image; that of the first rotates by the inverse.
        q = self.absolute
        turn = quaternions.multiply(
            quaternions.conjugate(q[:, j]), quaternions.multiply(self._relative[:, rows], q[:, i])
        )
        second = np.array([self._clusters_of[vote][1] for vote in votes])
        turn[:3] *= np.where(self._cluster[j] == second[run], 1.0, -1.0)
        self._turn[:, votes], support, rival = count_votes(turn, w, sizes)
        self._lead[votes] = support - rival
        self._fresh[votes] = True


def count_votes(turn: Array, weights: Array, sizes: IntArray) -> tuple[Array, Array, Array]:
    """Find the rotations of largest total weight in runs of votes.

    Parameters
    ----------
    turn : (4, m) array
        Quaternions voted for. The first ones of each run, which have the largest weights, are the hypotheses.
    weights : (m,) array
    sizes : (k,) int array
        Number of votes of each run.

    Returns
    -------
    winner : (4, k) array
        Mean of the quaternions that agree with the winning hypothesis.
    support, rival : (k,) array
        Total weight of the votes for the winner, and for the strongest hypothesis that disagrees with it.
    """
    starts, run = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    # Short runs repeat their last hypothesis, which does not change the result.
    put = np.minimum(np.arange(min(NUM_HYPOTHESES, int(sizes.max()))), sizes[:, None] - 1) + starts[:, None]
    hypotheses = turn[:, put]
    agree = agree_within(turn[:, :, None], hypotheses[:, run])
    support = np.add.reduceat(weights[:, None] * agree, starts, axis=0)
    best = (np.arange(len(sizes)), support.argmax(axis=1))
    winner = hypotheses[:, best[0], best[1]]
    rival = np.where(agree_within(hypotheses, winner[:, :, None]), 0.0, support).max(axis=1)
    for_winner = agree[np.arange(len(run)), best[1][run]]
    cosine = np.einsum("ck,ck->k", turn, winner[:, run])
    counted = np.where(for_winner, np.copysign(weights, cosine), 0.0)
    mean = np.add.reduceat(counted * turn, starts, axis=1)
    length = np.linalg.norm(mean, axis=0)
    return np.where(length > 0, mean / np.where(length > 0, length, 1.0), winner), support[best], rival


def agree_within(one: Array, other: Array) -> BoolArray:
    """Whether rotations, given as quaternions along the first axis, differ by less than `AGREEMENT_DEG`."""
    cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2] + one[3] * other[3]
    return np.asarray(np.abs(cosine) > np.cos(np.radians(0.5 * AGREEMENT_DEG)))
