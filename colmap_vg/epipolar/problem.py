"""Input of the epipolar adjustment: the matches of part of a graph, and which focal lengths are refined."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.depth_agreement import TripletRays
from colmap_vg.epipolar.triplets import Triplets, find_triplets
from colmap_vg.events import report_progress
from colmap_vg.options import SolveOptions
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.two_view.pieces import Pieces
from colmap_vg.two_view.radial_distortion import undistorted_rays
from colmap_vg.two_view.sampson import Matches, cut_rays
from colmap_vg.two_view.segments import rows_of_segments, segment_subset
from colmap_vg.two_view.spread import well_spread

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Lenses:
    """Logarithms (c,) of the factors on the focal lengths, and the radial term at the initial focal lengths."""

    log_scales: Array
    radial_term: float = 0.0


@dataclass(frozen=True, eq=False)
class EpipolarProblem:
    """Edges and matches of a part of a graph, with its cameras.

    Attributes
    ----------
    num_images : int
    edges : (m, 2) int64 array
    offsets : (m + 1,) int64 array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches, computed with `focal_lengths`.
    camera_idx : (n,) int64 array
        Camera of each image, a row of the arrays below; see `focal_groups`.
    focal_lengths : (c,) array
        Pixels.
    free_focals : (c,) bool array
        Cameras whose focal length is refined.
    triplets : Triplets or None
        Tracks shared by three images, which determine the ratios of baselines.
    keypoints1, keypoints2 : (k,) int array or None
        Keypoint indices of the matches in image 1 and image 2.
    bent_cameras : (c,) bool array or None
        Cameras of free focal length that share a radial term, which is refined; None if there is no term.
    """

    num_images: int
    edges: IntArray
    offsets: IntArray
    bearings1: Array
    bearings2: Array
    camera_idx: IntArray
    focal_lengths: Array
    free_focals: BoolArray
    triplets: Triplets | None = None
    keypoints1: NDArray[np.int32] | None = None
    keypoints2: NDArray[np.int32] | None = None
    bent_cameras: BoolArray | None = None

    @cached_property
    def _pieces(self) -> Pieces:
        return cut_rays(self.offsets, self.bearings1, self.bearings2)

    @property
    def lenses_are_free(self) -> bool:
        """Whether any focal length is refined."""
        return bool(self.free_focals.any())

    def matches(self, lenses: Lenses) -> Matches:
        """Matches as cameras with the given lenses see them."""
        camera = self.camera_idx[self.edges].T
        focal = self.focal_lengths[camera] * np.exp(lenses.log_scales[camera])
        ratios = np.exp(-lenses.log_scales[camera]) if self.lenses_are_free else None
        pieces, gains = self._undistorted(self._pieces, camera, lenses)
        return Matches(pieces, focal**-2.0, ratios, gains)

    def without(self, dropped: BoolArray) -> "EpipolarProblem":
        """The problem without the edges of a mask (m,)."""
        rows, offsets = rows_of_segments(self.offsets, np.flatnonzero(~dropped))
        triplets = None if self.triplets is None else self.triplets.without(dropped)
        return replace(
            self,
            edges=self.edges[~dropped],
            offsets=offsets,
            bearings1=self.bearings1[rows],
            bearings2=self.bearings2[rows],
            triplets=None if triplets is None or len(triplets.images) == 0 else triplets,
            keypoints1=None if self.keypoints1 is None else self.keypoints1[rows],
            keypoints2=None if self.keypoints2 is None else self.keypoints2[rows],
        )

    def triplet_rays(self, triplets: Triplets, lenses: Lenses) -> TripletRays:
        """Rays of triplets as cameras with the given lenses see them."""
        camera = self.camera_idx[triplets.images].T
        focal = self.focal_lengths[camera] * np.exp(lenses.log_scales[camera])
        ratios = np.exp(-lenses.log_scales[camera]) if self.lenses_are_free else None
        pieces, gains = self._undistorted(triplets.pieces, camera, lenses)
        return TripletRays(pieces, focal**-2.0, ratios, gains)

    def _undistorted(self, pieces: Pieces, camera: IntArray, lenses: Lenses) -> tuple[Pieces, Array | None]:
        """Pieces of rays after undistortion, and gains (p, s, length), for segments with cameras (s, m)."""
        if self.bent_cameras is None:
            return pieces, None
        bent = self.bent_cameras[camera[:, pieces.segments]]
        parts = [
            undistorted_rays(pieces.columns[:, 3 * s : 3 * s + 3], lenses.radial_term, seen)
            for s, seen in enumerate(bent)
        ]
        rays, gains = zip(*parts, strict=True)
        return replace(pieces, columns=np.concatenate(rays, axis=1)), np.stack(gains, axis=1)


def epipolar_problem(graph: ViewGraph, part: Subgraph, options: SolveOptions) -> EpipolarProblem | None:
    """Collect the matches of a part of a graph; None if the graph has no matches or no cameras.

    Parameters
    ----------
    graph : ViewGraph
    part : Subgraph
    options : SolveOptions
        `refine_focal_lengths`, `max_matches_per_edge` and `max_tracks_per_triplet`.

    Returns
    -------
    EpipolarProblem or None
    """
    offsets, rays1, rays2 = graph.inlier_offsets, graph.inlier_bearings1, graph.inlier_bearings2
    focals, camera_idx = graph.camera_focal_lengths, graph.camera_idx
    if offsets is None or rays1 is None or rays2 is None or focals is None or camera_idx is None:
        return None
    rows, part_offsets = rows_of_segments(offsets, part.edge_rows)
    if len(rows) == 0:
        return None
    group, of_group = focal_groups(graph)
    refined = {
        "always": np.ones(len(focals), dtype=np.bool_),
        "never": np.zeros(len(focals), dtype=np.bool_),
        "auto": np.zeros(len(focals), dtype=np.bool_)
        if graph.camera_focal_known is None
        else ~graph.camera_focal_known,
    }[options.refine_focal_lengths]
    triplets: Triplets | None = None
    if graph.inlier_keypoints1 is not None and graph.inlier_keypoints2 is not None:
        triplets = find_triplets(
            part.edges,
            part_offsets,
            graph.inlier_keypoints1[rows],
            graph.inlier_keypoints2[rows],
            rays1[rows],
            rays2[rows],
            graph.cam2_from_cam1_rotations[part.edge_rows],
            options.max_tracks_per_triplet,
        )
    # Triplets are formed from all matches: subsampled pairs share few tracks.
    report_progress("tracks")
    spread = well_spread(part_offsets, rays1[rows], options.max_matches_per_edge)
    rows, part_offsets = rows[spread], segment_subset(part_offsets, spread)
    report_progress("tracks")
    camera_idx = group[camera_idx[part.images]]
    seen = np.isin(np.arange(len(of_group)), camera_idx)
    focals, free = focals[of_group], refined[of_group] & seen
    return EpipolarProblem(
        part.num_images,
        part.edges,
        part_offsets,
        rays1[rows],
        rays2[rows],
        camera_idx,
        focals,
        np.asarray(free),
        triplets if triplets is not None and len(triplets.images) else None,
        None if graph.inlier_keypoints1 is None else graph.inlier_keypoints1[rows],
        None if graph.inlier_keypoints2 is None else graph.inlier_keypoints2[rows],
    )


def focal_groups(graph: ViewGraph) -> tuple[IntArray, IntArray]:
    """Group cameras of the same unknown focal length, which share one focal length in the adjustment.

    Photographs without EXIF have a camera each, with one focal length that all of them vote for. Few of them determine
    their own; bundle adjustment refines them separately.

    Parameters
    ----------
    graph : ViewGraph

    Returns
    -------
    group : (c,) int64 array
        Group of each camera.
    first : (g,) int64 array
        First camera of each group.
    """
    if graph.camera_focal_lengths is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    count = len(graph.camera_focal_lengths)
    known = np.zeros(count, dtype=bool) if graph.camera_focal_known is None else graph.camera_focal_known
    # Cameras with known focal length form groups of their own.
    own = np.where(known, np.arange(count), -1)
    keys = np.stack([graph.camera_focal_lengths, own], axis=1)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return group.reshape(-1).astype(np.int64), first.astype(np.int64)
