"""What is drawn of a solution: frusta of cameras, pairs as lines, in the frame of the job's model."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.report.models import frustum_depth
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import USED_EDGES, EdgeVerdict
from colmap_vg.viewer.session import Session

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Colors = NDArray[np.uint8]

USED, NOT_USED, EXCLUDED, TRUSTED = (150, 170, 190), (240, 150, 40), (220, 50, 50), (40, 170, 80)
"""Red, green and blue of pairs: used, not used, excluded by the user, trusted by the user."""
REGISTERED, IN_DOUBT = (30, 90, 200), (220, 50, 50)
"""Red, green and blue of cameras: of the largest model, and of those whose pose is in doubt."""
BESIDE = 1.4
"""Distance between two solutions side by side, as a share of their extent."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Arrays of a scene.

    Attributes
    ----------
    images : (k,) int64 array
        Rows of the registered images.
    rotations : (k, 3, 3) array
        world_from_cam rotations.
    centers : (k, 3) array
    fields_of_view : (k,) array
        Vertical, radians.
    aspects : (k,) array
        Width over height.
    camera_colors : (k, 3) uint8 array
    depth : float
        Of a frustum.
    pairs : (q,) int64 array
        Rows of the pairs between registered images.
    used : (q,) bool array
        Whether the solution uses them and the user has not marked them.
    segments : (q, 2, 3) array
    segment_colors : (q, 2, 3) uint8 array
    """

    images: IntArray
    rotations: Array
    centers: Array
    fields_of_view: Array
    aspects: Array
    camera_colors: Colors
    depth: float
    pairs: IntArray
    used: NDArray[np.bool_]
    segments: Array
    segment_colors: Colors


def drawing(session: Session, solution: PoseSolution) -> Drawing:
    """Arrays of the largest model of a solution."""
    graph = session.job.graph
    images = np.flatnonzero(solution.registered)
    sizes = session.job.sizes[images].astype(np.float64)
    focals = sizes.max(axis=1)
    if graph.camera_focal_lengths is not None and graph.camera_idx is not None:
        focals = (graph.camera_focal_lengths * solution.focal_scales)[graph.camera_idx[images]]
    colors = np.tile(np.array(REGISTERED, dtype=np.uint8), (len(images), 1))
    if solution.in_doubt is not None:
        colors[solution.in_doubt[images]] = IN_DOUBT
    pairs = np.flatnonzero(solution.registered[graph.edges].all(axis=1))
    verdicts = solution.edge_verdicts[pairs]
    trusted = session.trusted[pairs] & ~session.all_excluded[pairs]
    used = np.isin(verdicts, USED_EDGES)
    by_pair = np.where(used[:, None], USED, NOT_USED)
    by_pair[trusted] = TRUSTED
    excluded = verdicts == EdgeVerdict.EXCLUDED
    by_pair[excluded] = EXCLUDED
    centers = solution.projection_centers[images]
    return Drawing(
        images=images,
        rotations=np.swapaxes(solution.cam_from_world_rotations[images], 1, 2),
        centers=centers,
        fields_of_view=2.0 * np.arctan2(0.5 * sizes[:, 1], focals),
        aspects=sizes[:, 0] / sizes[:, 1],
        camera_colors=colors,
        depth=frustum_depth(centers, float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 1.0),
        pairs=pairs,
        used=used & ~trusted,
        segments=solution.projection_centers[graph.edges[pairs]],
        segment_colors=np.repeat(by_pair[:, None], 2, axis=1).astype(np.uint8),
    )


def side_by_side_shift(before: Drawing, after: Drawing) -> Array:
    """Translation (3,) that puts the second drawing beside the first, to the side of its shorter horizontal extent."""
    both = np.concatenate([before.centers, after.centers])
    extent = np.ptp(both, axis=0) if len(both) else np.ones(3)
    shift, side = np.zeros(3), int(np.argmin(extent[:2]))
    shift[side] = BESIDE * max(extent[side], 0.5 * extent.max())
    return shift
