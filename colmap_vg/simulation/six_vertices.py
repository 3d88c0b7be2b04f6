"""The six-vertex graph of Fig. 4 of Nasiri et al., for which the orthogonal metric gives two cameras wrong positions.

Four cameras are at the corners of a rhombus, and two close to each other near its centre, on the diagonal between
cameras 1 and 2, to which they are linked. If the directions from 1 and 2 are wrong by a few degrees, the best fit may
be a position behind one of them, where the sine of the angle is as small as in front. The paper gives no coordinates:
here the rhombus is two equilateral triangles, and the inner cameras are a hundredth of its side apart.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import SyntheticScene

Array = NDArray[np.float64]

SIX_CENTERS = np.array(
    [[-1, 0, 0], [1, 0, 0], [0, np.sqrt(3), 0], [0, -np.sqrt(3), 0], [-0.01, 0, 0], [0.01, 0, 0]], dtype=float
)
SIX_EDGES = np.array([[0, 2], [2, 1], [1, 3], [3, 0], [2, 3], [0, 4], [1, 4], [0, 5], [1, 5], [4, 5]])
CORNERS_IN_ORDER = np.array([0, 2, 1, 3])
INNER = np.array([4, 5])


def six_vertex_scene(error_deg: float = 5.0, *, seed: int = 0) -> SyntheticScene:
    """Make the graph with exact rotations and all directions rotated in its plane by one angle with random signs.

    Parameters
    ----------
    error_deg : float
        Angle, degrees.
    seed : int
        Random seed of the signs.

    Returns
    -------
    SyntheticScene
        All rotations are the identity.
    """
    i, j = SIX_EDGES.T
    sign = np.random.default_rng(seed).choice([-1.0, 1.0], len(SIX_EDGES))
    turn = so3.exp(np.radians(error_deg) * sign[:, None] * np.array([0.0, 0.0, 1.0]))
    directions = np.einsum("kab,kb->ka", turn, normalized(SIX_CENTERS[j] - SIX_CENTERS[i]))
    graph = ViewGraph(
        image_ids=np.arange(1, 7),
        edges=SIX_EDGES,
        cam2_from_cam1_rotations=np.tile(np.eye(3), (len(SIX_EDGES), 1, 1)),
        cam2_in_cam1_directions=directions,
    )
    return SyntheticScene(graph, np.tile(np.eye(3), (6, 1, 1)), SIX_CENTERS, np.zeros(len(SIX_EDGES), dtype=bool))


def inner_cameras_outside(centers: Array) -> NDArray[np.bool_]:
    """Whether each inner camera is outside the solved rhombus, after projection to its best plane.

    Parameters
    ----------
    centers : (6, 3) array
        Solved positions, any gauge.

    Returns
    -------
    (2,) bool array
    """
    corners = centers[CORNERS_IN_ORDER]
    middle = corners.mean(axis=0)
    plane = np.linalg.svd(corners - middle)[2][:2]
    flat, inner = (corners - middle) @ plane.T, (centers[INNER] - middle) @ plane.T
    side, to_inner = np.roll(flat, -1, axis=0) - flat, inner[:, None] - flat
    left = side[:, 0] * to_inner[..., 1] - side[:, 1] * to_inner[..., 0] > 0
    return np.asarray(~(left.all(axis=1) | (~left).all(axis=1)))
