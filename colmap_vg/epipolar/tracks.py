"""A few well-spread tracks of three views or more: what fixes the ratios of baselines along a line of cameras."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from colmap_vg.two_view.segments import segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_CELLS = 4  # along each side of an image
_TRACKS_PER_CELL = 2


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points by images.

    Attributes
    ----------
    offsets : (t + 1,) int64 array
        Observations of track k are rows ``offsets[k]:offsets[k + 1]``, in different images.
    images : (o,) int64 array
        Rows of images.
    bearings : (o, 3) array
        Unit rays.
    """

    offsets: IntArray
    images: IntArray
    bearings: Array

    @property
    def num_tracks(self) -> int:
        """Number of tracks t."""
        return len(self.offsets) - 1

    def of(self, observations: BoolArray, min_length: int = 3) -> "Tracks":
        """Some observations (o,), of tracks that keep `min_length` of them."""
        track = segment_of_rows(self.offsets)
        length = np.bincount(track[observations], minlength=self.num_tracks)
        kept = observations & (length >= min_length)[track]
        counts = np.where(length >= min_length, length, 0)
        return Tracks(
            np.concatenate([[0], np.cumsum(counts[counts > 0])]).astype(np.int64),
            self.images[kept],
            self.bearings[kept],
        )


def spread_tracks(
    num_images: int,
    edges: IntArray,
    offsets: IntArray,
    keypoints1: NDArray[np.int32],
    keypoints2: NDArray[np.int32],
    bearings1: Array,
    bearings2: Array,
) -> Tracks:
    """The longest tracks in every part of every image.

    Matches are joined to tracks; a track that comes to the same image twice is wrong somewhere and is left out.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    keypoints1, keypoints2 : (k,) int array
        Keypoints of each match in image 1 and 2.
    bearings1, bearings2 : (k, 3) array
        Their unit rays.

    Returns
    -------
    Tracks
        With three observations or more each.
    """
    edge = segment_of_rows(offsets)
    image = np.concatenate([edges[edge, 0], edges[edge, 1]])
    keypoint = np.concatenate([keypoints1, keypoints2]).astype(np.int64)
    stride = int(keypoint.max(initial=0)) + 1
    features, first, node = np.unique(image * stride + keypoint, return_index=True, return_inverse=True)
    links = sp.coo_array(
        (np.ones(len(edge), dtype=np.int8), (node[: len(edge)], node[len(edge) :])), shape=(len(features),) * 2
    )
    _, label = connected_components(links, directed=False)
    # Observations in order of track and image.
    of_image = features // stride
    order = np.lexsort((of_image, label))
    label, of_image = label[order], of_image[order]
    bearings = np.concatenate([bearings1, bearings2])[first[order]]
    length = np.bincount(label)
    twice = np.zeros(len(length), dtype=bool)
    twice[label[1:][(label[1:] == label[:-1]) & (of_image[1:] == of_image[:-1])]] = True
    good = ((length >= 3) & ~twice)[label]
    label, of_image, bearings = label[good], of_image[good], bearings[good]
    chosen = np.zeros(len(length), dtype=bool)
    chosen[label[_foremost(num_images, of_image, bearings, length[label])]] = True
    kept = chosen[label]
    counts = np.bincount(label[kept], minlength=len(length))
    return Tracks(np.concatenate([[0], np.cumsum(counts[counts > 0])]).astype(np.int64), of_image[kept], bearings[kept])


def _foremost(num_images: int, images: IntArray, bearings: Array, lengths: IntArray) -> IntArray:
    """Observations of the longest tracks in each cell of each image."""
    plane = bearings[:, :2] / np.maximum(bearings[:, 2:], 0.1)
    by_image = np.argsort(images, kind="stable")
    counts = np.bincount(images, minlength=num_images)
    starts = (np.cumsum(counts) - counts)[counts > 0]
    low, high = np.zeros((num_images, 2)), np.zeros((num_images, 2))
    low[counts > 0] = np.minimum.reduceat(plane[by_image], starts, axis=0)
    high[counts > 0] = np.maximum.reduceat(plane[by_image], starts, axis=0)
    share = (plane - low[images]) / np.maximum(high - low, 1e-12)[images]
    place = np.minimum((share * _CELLS).astype(np.int64), _CELLS - 1)
    cell = (images * _CELLS + place[:, 0]) * _CELLS + place[:, 1]
    if not len(cell):
        return np.zeros(0, dtype=np.int64)
    order = np.lexsort((-lengths, cell))
    ordered = cell[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    rank = np.arange(len(ordered)) - np.repeat(starts, np.diff(np.concatenate([starts, [len(ordered)]])))
    return order[rank < _TRACKS_PER_CELL]


def triangulated(tracks: Tracks, rotations: Array, centers: Array) -> Array:
    """Points nearest to the rays of each track, least sum of squared distances: (t, 3).

    Parameters
    ----------
    tracks : Tracks
    rotations : (n, 3, 3) array
        cam_from_world.
    centers : (n, 3) array
    """
    rays = np.einsum("oba,ob->oa", rotations[tracks.images], tracks.bearings)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    starts = tracks.offsets[:-1]
    if not len(starts):
        return np.zeros((0, 3))
    matrix = np.add.reduceat(across, starts, axis=0)
    right = np.add.reduceat(np.einsum("oab,ob->oa", across, centers[tracks.images]), starts, axis=0)
    # Parallel rays leave the depth open: pulled towards the cameras a little, it stays finite.
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0])
