"""Absolute rotations by votes: clusters of images merge where the edges between them agree best on how.

A spanning tree believes every edge that it takes. Here an edge decides alone only while nothing else links its images:
all edges between two clusters vote on the turn that joins them, and the two whose vote has the largest lead merge
first. A false edge, however strong, is outvoted once clusters have formed.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.geometry import quaternions
from colmap_vg.rotations.problem import checked_problem

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

POLLED_AT_ONCE = 16
"""Votes that are taken together: array operations on one alone are mostly overhead."""
AGREEMENT_DEG = 8.0
"""Turns this close agree: the noise of weak pairs, and the drift that clusters have gathered."""
NUM_HYPOTHESES = 12
"""Edges between two clusters whose turns are put to the vote, the heaviest."""


def rotations_by_votes(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    weights: ArrayLike | None = None,
) -> Array:
    """Rotations of clusters that merged by weighted majority until one was left.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array, optional
        Votes of each edge. Default: one. Edges of weight zero have none.

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
    voting = w > 0
    clusters = _Clusters(num_images, edges[voting], quaternions.from_matrices(relative[voting]), w[voting])
    for _ in range(num_images - 1):
        clusters.merge_best()
    return quaternions.to_matrices(clusters.absolute)


class _Clusters:
    """Images in clusters with a frame each, and the standing vote between any two that edges link.

    Votes are taken anew only when they come first by an upper bound of their lead: most never are.
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
        self._voters = [rows.tolist() for rows in np.split(by_vote, np.cumsum(np.bincount(row))[:-1])]
        self._clusters_of = np.stack([pairs // num_images, pairs % num_images], axis=1).tolist()
        self._vote_with: list[dict[int, int]] = [{} for _ in range(num_images)]
        for vote, (a, b) in enumerate(self._clusters_of):
            self._vote_with[a][b] = self._vote_with[b][a] = vote
        # Upper bounds where a vote is not fresh.
        self._lead = np.bincount(row, weights)
        self._fresh = np.zeros(len(pairs), dtype=bool)
        self._turn = np.zeros((4, len(pairs)))
        self._poll(np.arange(len(pairs)))

    def merge_best(self) -> None:
        """Merge the two clusters whose vote has the largest lead."""
        best = int(np.argmax(self._lead))
        while not self._fresh[best]:
            self._poll(self._foremost(best))
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
        for other, vote in joining.items():
            del self._vote_with[other][moved]
            standing = own.get(other)
            if standing is None:
                own[other] = self._vote_with[other][into] = standing = vote
                self._clusters_of[vote] = [into, other]
            else:
                self._voters[standing] += self._voters[vote]
                self._lead[standing] += sum(self._weights[self._voters[vote]].tolist())
                self._lead[vote] = -np.inf
            self._fresh[standing] = False

    def _foremost(self, best: int) -> IntArray:
        """Votes to be taken anew: the best, and others that are not fresh and may lead by as much as it does."""
        if len(self._lead) <= POLLED_AT_ONCE:
            return np.flatnonzero(~self._fresh & np.isfinite(self._lead))
        near = np.argpartition(-self._lead, POLLED_AT_ONCE)[:POLLED_AT_ONCE]
        near = near[~self._fresh[near] & (self._lead[near] > 0.5 * self._lead[best])]
        return np.union1d(near, best)

    def _poll(self, votes: IntArray) -> None:
        """Take votes anew."""
        voters = [self._voters[vote] for vote in votes]
        sizes = np.array([len(v) for v in voters])
        rows = np.array([row for v in voters for row in v], dtype=np.int64)
        run = np.repeat(np.arange(len(votes)), sizes)
        rows = rows[np.lexsort((rows, -self._weights[rows], run))]
        i, j, w = self._i[rows], self._j[rows], self._weights[rows]
        # R_ij = R_j Q R_i^T where Q turns the second image's cluster; the first image's turns by the inverse.
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
    """Turns that most weight wants, in runs of votes.

    Parameters
    ----------
    turn : (4, m) array
        Quaternions voted for. The first ones of each run, its heaviest, are the hypotheses.
    weights : (m,) array
    sizes : (k,) int array
        Votes of each run.

    Returns
    -------
    winner : (4, k) array
        Mean of the turns that agree with the winning hypothesis.
    support, rival : (k,) array
        Weight that agrees with the winner, and with the strongest hypothesis that does not.
    """
    starts, run = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    # Short runs put their last edge's turn more than once, which changes nothing.
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
    """Whether rotations, quaternions along the first axis, are within `AGREEMENT_DEG` of each other."""
    cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2] + one[3] * other[3]
    return np.asarray(np.abs(cosine) > np.cos(np.radians(0.5 * AGREEMENT_DEG)))
