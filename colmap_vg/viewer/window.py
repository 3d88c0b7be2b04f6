"""A finished job in a window of Open3D: cameras, pairs and points, as the explorer draws them, without its controls."""

import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import ViewerError
from colmap_vg.viewer.drawing import Drawing, drawing
from colmap_vg.viewer.session import Session

Array = NDArray[np.float64]

NO_WINDOW = "no window can be opened here, as there is no display: use --backend viser and a browser"
WIDTH, HEIGHT = 1280, 800
"""Size of the window, pixels."""
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
"""Lines of a frustum: from its tip to its corners, and around these."""


def show_window(session: Session) -> None:
    """Open a window, and return when it is closed.

    Raises
    ------
    ViewerError
        No window can be opened, as on a server without a display.
    """
    import open3d

    # Open3D waits for ever where there is no display.
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(NO_WINDOW)
    viewer = open3d.visualization.Visualizer()
    if not viewer.create_window("colmap-vg", WIDTH, HEIGHT):
        raise ViewerError(NO_WINDOW)
    for geometry in geometries(session):
        viewer.add_geometry(geometry)
    viewer.run()
    viewer.destroy_window()


def geometries(session: Session) -> list[Any]:
    """Open3D's geometries of a session: frusta and pairs as line sets, and the points of the job's model."""
    import open3d

    drawn, points = drawing(session, session.after), session.job.points.astype(np.float64)
    corners, lines, colors = frusta(drawn)
    found = [_line_set(corners, lines, colors), _line_set(*_pair_lines(drawn))]
    if len(points):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.colors = open3d.utility.Vector3dVector(session.job.colors / 255.0)
        found.append(cloud)
    return found


def frusta(drawn: Drawing) -> tuple[Array, NDArray[np.int64], Array]:
    """Frusta of the cameras.

    Returns
    -------
    points : (5 k, 3) array
        Tip and corners of each.
    lines : (8 k, 2) int64 array
        Rows of the points.
    colors : (8 k, 3) array
        Between 0 and 1.
    """
    k = len(drawn.images)
    half = drawn.depth * np.tan(0.5 * drawn.fields_of_view)
    local = np.zeros((k, 5, 3))
    for corner, (x, y) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1)), start=1):
        local[:, corner] = np.stack([x * half * drawn.aspects, y * half, np.full(k, drawn.depth)], axis=1)
    points = np.einsum("kab,kcb->kca", drawn.rotations, local) + drawn.centers[:, None]
    lines = (_EDGES + 5 * np.arange(k)[:, None, None]).reshape(-1, 2)
    return points.reshape(-1, 3), lines, np.repeat(drawn.camera_colors / 255.0, len(_EDGES), axis=0)


def _pair_lines(drawn: Drawing) -> tuple[Array, NDArray[np.int64], Array]:
    ends = drawn.segments.reshape(-1, 3)
    return ends, np.arange(len(ends)).reshape(-1, 2), drawn.segment_colors[:, 0] / 255.0


def _line_set(points: Array, lines: NDArray[np.int64], colors: Array) -> Any:
    import open3d

    found = open3d.geometry.LineSet(open3d.utility.Vector3dVector(points), open3d.utility.Vector2iVector(lines))
    found.colors = open3d.utility.Vector3dVector(colors)
    return found
