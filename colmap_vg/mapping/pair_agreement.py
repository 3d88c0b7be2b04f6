"""Compare the rotations of a finished model with those of its pairs, to find misplaced images and folded parts.

Points can register an image at a look-alike of what it shows; the two-view geometries of its pairs then contradict
the rotation.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.edge_residuals import rotation_residuals

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_ROTATION_DEG = 15.0
"""Maximum angle, degrees, between a pair's relative rotation and the model's; that of weak correct pairs reached 10."""
MIN_CONTRADICTING, MIN_PART_IMAGES = 3, 3
"""Minimum number of pairs that contradict an image, since one or two weak ones are often wrong themselves; minimum
number of images of a part."""


@dataclass(frozen=True, eq=False)
class PairRotations:
    """Relative rotations of the pairs whose matches determine one.

    Attributes
    ----------
    image_ids : (m, 2) int64 array
    cam2_from_cam1_rotations : (m, 3, 3) array
    num_matches : (m,) array
    """

    image_ids: IntArray
    cam2_from_cam1_rotations: Array
    num_matches: Array


@dataclass(frozen=True)
class PairAgreement:
    """Images and parts of a model that its pairs contradict or do not link.

    Attributes
    ----------
    contradicted : frozenset of int
        Ids of images whose rotation three pairs or more contradict, with more than half of the image's matches.
    detached : tuple of frozenset of int
        Parts of three images or more that no agreeing pair links to the largest part.
    """

    contradicted: frozenset[int]
    detached: tuple[frozenset[int], ...]


def pair_agreement(reconstruction: "pycolmap.Reconstruction", pairs: PairRotations) -> PairAgreement:
    """Compare a model's rotations with those of its pairs.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    pairs : PairRotations
        Pairs with an image outside the model do not count.
    """
    ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    edges, matches, agree = _compared(reconstruction, ids, pairs)
    if len(edges) == 0:
        return PairAgreement(frozenset(), ())
    whole, good = (
        np.bincount(edges.ravel(), weights=np.repeat(w, 2), minlength=len(ids)) for w in (matches, matches * agree)
    )
    number = np.bincount(edges[~agree].ravel(), minlength=len(ids))
    contradicted = frozenset(ids[(good < 0.5 * whole) & (number >= MIN_CONTRADICTING)].tolist())
    linked = np.concatenate([edges[agree], _frame_edges(reconstruction, ids)])
    return PairAgreement(contradicted, _detached(ids, linked, np.unique(edges)))


def agreeing_pairs(
    reconstruction: "pycolmap.Reconstruction", image_ids: IntArray, pairs: PairRotations
) -> tuple[IntArray, Array]:
    """Pairs (m, 2) of rows of the ascending `image_ids` that agree with a model, and their numbers of matches (m,).

    Images of one frame of a rig count as a pair with as many matches as the strongest.
    """
    edges, matches, agree = _compared(reconstruction, image_ids, pairs)
    together = _frame_edges(reconstruction, image_ids)
    firm = np.full(len(together), matches[agree].max(initial=1.0))
    return np.concatenate([edges[agree], together]), np.concatenate([matches[agree], firm])


def _frame_edges(reconstruction: "pycolmap.Reconstruction", ids: IntArray) -> IntArray:
    """Pairs (k, 2) of rows of images that follow each other in one frame of a rig."""
    frames = np.array([reconstruction.image(i).frame_id for i in ids.tolist()], dtype=np.int64)
    order = np.argsort(frames, kind="stable")
    same = np.flatnonzero(np.diff(frames[order]) == 0)
    return np.sort(np.stack([order[same], order[same + 1]], axis=1), axis=1)


def _compared(
    reconstruction: "pycolmap.Reconstruction", ids: IntArray, pairs: PairRotations
) -> tuple[IntArray, Array, BoolArray]:
    """Rows of the images of pairs inside the model (m, 2), their matches (m,), and whether they agree with it (m,)."""
    inside = np.isin(pairs.image_ids, ids).all(axis=1)
    edges = np.searchsorted(ids, pairs.image_ids[inside])
    rotations = [reconstruction.image(i).cam_from_world().rotation.matrix() for i in ids.tolist()]
    residuals = rotation_residuals(edges, pairs.cam2_from_cam1_rotations[inside], np.array(rotations).reshape(-1, 3, 3))
    matches = np.asarray(pairs.num_matches[inside], dtype=np.float64)
    return edges, matches, residuals <= np.radians(MAX_ROTATION_DEG)


def _detached(ids: IntArray, edges: IntArray, with_pairs: IntArray) -> tuple[frozenset[int], ...]:
    """Components of the graph of agreeing pairs, without the largest, small ones, and images without any pair."""
    part = components_by_size(len(ids), edges)[with_pairs]
    largest = part.min(initial=0)
    sizes = np.bincount(part)
    return tuple(
        frozenset(ids[with_pairs[part == k]].tolist())
        for k in np.flatnonzero(sizes >= MIN_PART_IMAGES).tolist()
        if k != largest
    )
