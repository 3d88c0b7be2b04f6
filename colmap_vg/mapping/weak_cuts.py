"""Where few pairs hold a model together: is what both sides should see seen by both?

Parts of two scenes that look alike, or two ends of one, are joined by false pairs whose tracks agree with each other.
But once they lie over one another, images of one side should see the points of the other, and do so only where the
parts are alike (missing correspondences, as in :mod:`colmap_vg.mapping.second_opinion`). Only pairs of images that were
compared count: what nobody matched is not missing.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized
from colmap_vg.mapping.pair_agreement import PairRotations, agreeing_pairs
from colmap_vg.mapping.visibility import NEAR_DEG, in_frame, sampled_tracks
from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.normalized_cut import normalized_cut
from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_CONDUCTANCE = 0.2
"""Of a cut that is weak. Photographs of one place had 0.03 (a ring of 47) to 0.33 at their weakest cut."""
MIN_IMAGES, MAX_NUM_CUTS = 3, 6
"""Of a side; and cuts that are looked at, of the largest parts first."""
MAX_DISTANCE_RATIO = 1.3
"""Of two images from a point that both should see: along a street features are lost as they grow."""
MAX_NUM_POINTS = 1500
MIN_EXPECTED = 30
"""Observations, below which nothing can be told."""
MIN_SHARE_OF_USUAL = 0.65
"""Share of what should be seen across a cut that is, over the share elsewhere: 0.77 to 1.13 on photographs and in
simulated scenes of one place, linked by one pair or many; 0.10 to 0.58 where two places with a third of their points
alike lay over one another."""


@dataclass(frozen=True)
class WeakCut:
    """Two sides of a model that few pairs link.

    Attributes
    ----------
    images : frozenset of int
        Ids of the smaller side's images. The other side is the rest of the model, or of a side of an earlier cut.
    num_pairs, num_matches : int
        Pairs across that agree with the model, and their inlier matches.
    num_expected, num_seen : int
        Of points that one side sees, looked for in near images of the other that were compared with it; and found.
    share_seen_elsewhere : float
        Of what should be seen on the same side, the share that is.
    """

    images: frozenset[int]
    num_pairs: int
    num_matches: int
    num_expected: int
    num_seen: int
    share_seen_elsewhere: float

    @property
    def share_seen(self) -> float:
        """Share of what should be seen across that is; 0 where nothing should."""
        return self.num_seen / self.num_expected if self.num_expected else 0.0

    @property
    def contradicted(self) -> bool:
        """Whether too little is seen across for the sides to show one place."""
        usual = MIN_SHARE_OF_USUAL * self.share_seen_elsewhere
        return self.num_expected >= MIN_EXPECTED and self.share_seen < usual


def weak_cuts(
    reconstruction: "pycolmap.Reconstruction", pairs: PairRotations, compared: IntArray
) -> tuple[WeakCut, ...]:
    """Cuts of a finished model that few pairs cross, and what its points say of each.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    pairs : PairRotations
    compared : (k, 2) int64 array
        Ids of images that were compared, whether or not they matched.

    Returns
    -------
    tuple of WeakCut
    """
    image_ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    links = agreeing_pairs(reconstruction, image_ids, pairs)
    return _judged(reconstruction, image_ids, links, compared, _weak_sides(len(image_ids), *links))


def cut_along(
    reconstruction: "pycolmap.Reconstruction", pairs: PairRotations, compared: IntArray, images: Iterable[int]
) -> WeakCut:
    """The cut between some images of a model, by their ids, and the rest; see :func:`weak_cuts`."""
    image_ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    links = agreeing_pairs(reconstruction, image_ids, pairs)
    side = np.isin(image_ids, sorted(images))
    (cut,) = _judged(reconstruction, image_ids, links, compared, [(np.ones(len(image_ids), dtype=bool), side)])
    return cut


def _judged(
    reconstruction: "pycolmap.Reconstruction",
    image_ids: IntArray,
    links: tuple[IntArray, Array],
    compared: IntArray,
    sides: list[tuple[BoolArray, BoolArray]],
) -> tuple[WeakCut, ...]:
    """Cuts of parts (n,) into a side (n,) and the rest, with what points say of them."""
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
    """Parts (n,) and smaller sides (n,) of their weak cuts: the largest component, and then the sides of cuts."""
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
    """Edges by rows among the images marked (n,)."""
    return np.asarray(np.cumsum(images)[edges] - 1)


@dataclass(frozen=True, eq=False)
class _Expected:
    """Points that an image (j,) should see because a near one (i,) sees them, and whether it does."""

    points: IntArray
    images: IntArray
    near: IntArray
    seen: BoolArray

    def counts(self, part: BoolArray, side: BoolArray, across: bool) -> tuple[int, int]:
        """Points and images expected in a part by images of the other side or the same, and of these the seen ones."""
        counted = ((side[self.images] != side[self.near]) == across) & part[self.images] & part[self.near]
        keys, first = np.unique(self.points[counted] * len(side) + self.images[counted], return_index=True)
        return len(keys), int(self.seen[counted][first].sum())


def _expected(reconstruction: "pycolmap.Reconstruction", image_ids: IntArray, compared: IntArray) -> _Expected:
    n, ids = len(image_ids), image_ids.tolist()
    rows = np.searchsorted(image_ids, compared[np.isin(compared, image_ids).all(axis=1)])
    were_compared = np.zeros((n, n), dtype=bool)
    were_compared[rows[:, 0], rows[:, 1]] = were_compared[rows[:, 1], rows[:, 0]] = True
    tracks = sampled_tracks(reconstruction, ids, MAX_NUM_POINTS)
    point_of_sight, looking = np.nonzero(in_frame(reconstruction, ids, tracks.points))
    sights = np.concatenate([[0], np.cumsum(np.bincount(point_of_sight, minlength=len(tracks.points)))])
    seen_point, seeing = np.nonzero(tracks.sees)
    # Each image that sees a point beside each that it lies in the frame of.
    rows, offsets = rows_of_segments(sights.astype(np.int64), seen_point)
    beside = segment_of_rows(offsets)
    point, image, near = point_of_sight[rows], looking[rows], seeing[beside]
    centers = np.array([reconstruction.image(i).projection_center() for i in ids])
    to_image, to_near = centers[image] - tracks.points[point], centers[near] - tracks.points[point]
    farther = np.log(np.linalg.norm(to_image, axis=1) / np.linalg.norm(to_near, axis=1))
    cosine = np.einsum("ka,ka->k", normalized(to_image), normalized(to_near))
    expected = (cosine >= np.cos(np.radians(NEAR_DEG))) & (np.abs(farther) <= np.log(MAX_DISTANCE_RATIO))
    expected &= were_compared[image, near]
    return _Expected(point[expected], image[expected], near[expected], tracks.sees[point, image][expected])
