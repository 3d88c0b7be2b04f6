"""Find weak cuts of a model, which few pairs cross, and check each by missing correspondences.

False pairs join parts of two scenes that look alike, or two ends of one scene, and their tracks agree with each other.
But once the parts overlap in the model, images of one side should see the points of the other, and do so only where
the parts are alike (missing correspondences, as in :mod:`colmap_vg.mapping.second_opinion`). Only pairs of images that
were compared count: a correspondence is not missing where no matching was tried.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_vg.mapping.pair_agreement import PairRotations, agreeing_pairs
from colmap_vg.mapping.visibility import NEAR_DEG, in_frame, sampled_tracks
from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.normalized_cut import normalized_cut
from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_CONDUCTANCE = 0.2
"""Maximum conductance of a weak cut, dimensionless. The weakest cut of photographs of one place had 0.03 (a ring of 47)
to 0.33."""
MIN_IMAGES, MAX_NUM_CUTS = 3, 6
"""Minimum number of images on each side; maximum number of cuts, those of the largest parts first."""
MAX_DISTANCE_RATIO = 1.3
"""Maximum ratio of the distances of two images from a point that both should see: along a street, features are no
longer detected as their scale in the image grows."""
MAX_FORESHORTENING = 0.3
"""Largest relative difference of the cosines under which two images look at the surface around a point that both should
see. It also leaves out what one of them sees from behind, and what hides behind a corner."""
NUM_NEIGHBORS, MAX_FLATNESS = 12, 0.05
"""Points that determine the normal of the surface; maximum ratio of their two smallest variances where it is one."""
MAX_NUM_POINTS = 1000
"""Maximum number of sampled points."""
MIN_EXPECTED = 30
"""Minimum number of expected observations across a cut to judge it."""
MIN_SHARE_OF_USUAL = 0.65
"""Minimum ratio of the share of expected observations that exist across a cut to that share elsewhere: measured 0.77 to
1.13 on photographs and simulated scenes of one place, linked by one pair or many; 0.10 to 0.58 where two places with a
third of their points alike overlapped."""


@dataclass(frozen=True)
class WeakCut:
    """Two sides of a model that few pairs link.

    Attributes
    ----------
    images : frozenset of int
        Ids of the smaller side's images. The other side is the rest of the model, or of a side of an earlier cut.
    num_pairs, num_matches : int
        Number of pairs across the cut that agree with the model, and of their inlier matches.
    num_expected, num_seen : int
        Number of expected observations across the cut (points that an image of one side sees and a near image of the
        other, compared with it, should see), and of those that exist.
    share_seen_elsewhere : float
        Share of the expected observations within the sides that exist.
    """

    images: frozenset[int]
    num_pairs: int
    num_matches: int
    num_expected: int
    num_seen: int
    share_seen_elsewhere: float

    @property
    def share_seen(self) -> float:
        """Share of the expected observations across the cut that exist; 0 without any."""
        return self.num_seen / self.num_expected if self.num_expected else 0.0

    @property
    def contradicted(self) -> bool:
        """Whether too few expected observations exist across the cut, by a standard deviation, for one place."""
        if self.num_expected < MIN_EXPECTED:
            return False
        usual = MIN_SHARE_OF_USUAL * self.share_seen_elsewhere
        return bool(self.share_seen + np.sqrt(usual * (1.0 - usual) / self.num_expected) < usual)


def weak_cuts(
    reconstruction: "pycolmap.Reconstruction", pairs: PairRotations, compared: IntArray
) -> tuple[WeakCut, ...]:
    """Find the cuts of a finished model that few pairs cross, and count the expected observations across each.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    pairs : PairRotations
    compared : (k, 2) int64 array
        Ids of the image pairs that were compared, whether or not they matched.

    Returns
    -------
    tuple of WeakCut
    """
    image_ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    links = agreeing_pairs(reconstruction, image_ids, pairs)
    return _evaluated_cuts(reconstruction, image_ids, links, compared, _weak_sides(len(image_ids), *links))


def cut_along(
    reconstruction: "pycolmap.Reconstruction", pairs: PairRotations, compared: IntArray, images: Iterable[int]
) -> WeakCut:
    """Evaluate the cut between the images of given ids and the rest of a model, as :func:`weak_cuts` does."""
    image_ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    links = agreeing_pairs(reconstruction, image_ids, pairs)
    side = np.isin(image_ids, sorted(images))
    (cut,) = _evaluated_cuts(reconstruction, image_ids, links, compared, [(np.ones(len(image_ids), dtype=bool), side)])
    return cut


def _evaluated_cuts(
    reconstruction: "pycolmap.Reconstruction",
    image_ids: IntArray,
    links: tuple[IntArray, Array],
    compared: IntArray,
    sides: list[tuple[BoolArray, BoolArray]],
) -> tuple[WeakCut, ...]:
    """Count pairs and expected observations across cuts, each given by a part (n,) and one of its sides (n,)."""
    if not sides:
        return ()
    edges, matches = links
    expected = _expected(reconstruction, image_ids, compared)
    found, whole = [], np.ones(len(image_ids), dtype=bool)
    for part, side in sides:
        across = (side[edges[:, 0]] != side[edges[:, 1]]) & part[edges].all(axis=1)
        (num_expected, num_seen), elsewhere = expected.counts(part, side, True), expected.counts(whole, side, False)
        found.append(
            WeakCut(
                frozenset(image_ids[side].tolist()),
                int(across.sum()),
                int(matches[across].sum()),
                num_expected,
                num_seen,
                elsewhere[1] / max(elsewhere[0], 1),
            )
        )
    return tuple(found)


def _weak_sides(num_images: int, edges: IntArray, matches: Array) -> list[tuple[BoolArray, BoolArray]]:
    """Parts (n,) with a weak cut and its smaller side (n,): the largest component first, then the sides of cuts."""
    sides: list[tuple[BoolArray, BoolArray]] = []
    parts = [components_by_size(num_images, edges) == 0] if len(edges) else []
    while parts and len(sides) < MAX_NUM_CUTS:
        part = parts.pop(int(np.argmax([p.sum() for p in parts])))
        if part.sum() < 2 * MIN_IMAGES:
            break
        inside = part[edges].all(axis=1)
        images = np.flatnonzero(part)
        local, conductance = normalized_cut(
            len(images), np.searchsorted(images, edges[inside]), matches[inside], MIN_IMAGES
        )
        if conductance > MAX_CONDUCTANCE:
            continue
        side = np.zeros(num_images, dtype=bool)
        side[images[local]] = True
        sides.append((part, side))
        for half in (side, part & ~side):
            own = half[edges].all(axis=1)
            whole = np.zeros(num_images, dtype=bool)
            whole[np.flatnonzero(half)[components_by_size(int(half.sum()), _within(half, edges[own])) == 0]] = True
            parts.append(whole)
    return sides


def _within(images: BoolArray, edges: IntArray) -> IntArray:
    """Renumber the ends of edges to rows among the marked images (n,)."""
    return np.asarray(np.cumsum(images)[edges] - 1)


@dataclass(frozen=True, eq=False)
class _Expected:
    """Expected observations (k,): a point, an image that should see it, a near image that sees it, and if it exists."""

    points: IntArray
    images: IntArray
    near: IntArray
    seen: BoolArray

    def counts(self, part: BoolArray, side: BoolArray, across: bool) -> tuple[int, int]:
        """Numbers of expected and existing observations in a part, across its cut or within its sides."""
        counted = ((side[self.images] != side[self.near]) == across) & part[self.images] & part[self.near]
        keys, first = np.unique(self.points[counted] * len(side) + self.images[counted], return_index=True)
        return len(keys), int(self.seen[counted][first].sum())


def _expected(reconstruction: "pycolmap.Reconstruction", image_ids: IntArray, compared: IntArray) -> _Expected:
    n, ids = len(image_ids), image_ids.tolist()
    rows = np.searchsorted(image_ids, compared[np.isin(compared, image_ids).all(axis=1)])
    were_compared = np.zeros((n, n), dtype=bool)
    were_compared[rows[:, 0], rows[:, 1]] = were_compared[rows[:, 1], rows[:, 0]] = True
    tracks = sampled_tracks(reconstruction, ids, MAX_NUM_POINTS)
    # A sight: a point, and an image that sees it or into which it projects.
    point, image = np.nonzero(tracks.sees | in_frame(reconstruction, ids, tracks.points))
    sights = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(tracks.points)))]).astype(np.int64)
    centers = np.array([reconstruction.image(i).projection_center() for i in ids])
    rays = centers[image] - tracks.points[point]
    distance = np.linalg.norm(rays, axis=1)
    rays /= distance[:, None]
    normals, flat = _normals(tracks.every, tracks.points)
    facing = np.einsum("ka,ka->k", normals[point], rays)
    # Pair each sight of a point with each image that sees the point.
    seen = tracks.sees[point, image]
    seeing = np.flatnonzero(seen)
    sight, offsets = rows_of_segments(sights, point[seeing])
    near = seeing[segment_of_rows(offsets)]
    alike = were_compared[image[sight], image[near]]
    alike &= np.abs(np.log(distance[sight] / distance[near])) <= np.log(MAX_DISTANCE_RATIO)
    alike &= ~flat[point[sight]] | (np.abs(facing[sight] / facing[near] - 1.0) <= MAX_FORESHORTENING)
    sight, near = sight[alike], near[alike]
    parallel = sum(ray[sight] * ray[near] for ray in rays.T.copy()) >= np.cos(np.radians(NEAR_DEG))
    sight, near = sight[parallel], near[parallel]
    return _Expected(point[sight], image[sight], image[near], seen[sight])


def _normals(every: Array, points: Array) -> tuple[Array, BoolArray]:
    """Normals (k, 3), of either sign, of the surface through points (k, 3) and their neighbours, and if it is flat."""
    neighbors = every[cKDTree(every).query(points, min(NUM_NEIGHBORS, len(every)))[1]].reshape(len(points), -1, 3)
    deviations = neighbors - neighbors.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(deviations, 1, 2) @ deviations)
    return vectors[:, :, 0], np.asarray(values[:, 0] <= MAX_FLATNESS * values[:, 1])
