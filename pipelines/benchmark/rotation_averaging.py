"""Rotation averaging by pycolmap on the edges of a viewing graph, and its time."""

import time

import numpy as np
import pycolmap

from colmap_vg.scene.view_graph import ViewGraph

UNKNOWN_NUM_MATCHES = 100
"""Of each edge of a graph that does not tell."""


def averaged_by_pycolmap(graph: ViewGraph) -> tuple[pycolmap.Reconstruction, float]:
    """Run ``pycolmap.run_rotation_averaging`` on the same relative poses.

    Parameters
    ----------
    graph : ViewGraph
        Of several edges between two images only the first is taken: pycolmap takes no second one.

    Returns
    -------
    pycolmap.Reconstruction
        With the rotations of the images that it registers.
    float
        Seconds of the call alone.
    """
    reconstruction, pose_graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1000, height=1000, params=[1000, 500, 500], camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for image_id in graph.image_ids.tolist():
        image = pycolmap.Image(name=f"{image_id}.jpg", camera_id=1, image_id=image_id)
        reconstruction.add_image_with_trivial_frame(image)
    counts = np.full(graph.num_edges, UNKNOWN_NUM_MATCHES) if graph.num_inliers is None else graph.num_inliers
    _, first = np.unique(np.sort(graph.edges, axis=1), axis=0, return_index=True)
    rows = np.sort(first)
    for (i, j), R, direction, count in zip(
        graph.image_ids[graph.edges[rows]].tolist(),
        graph.cam2_from_cam1_rotations[rows],
        graph.cam2_in_cam1_directions[rows],
        counts[rows].tolist(),
        strict=True,
    ):
        edge = pycolmap.PoseGraphEdge()
        edge.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ direction)
        edge.num_matches = count
        pose_graph.add_edge(i, j, edge)
    start = time.perf_counter()
    pycolmap.run_rotation_averaging(pycolmap.RotationEstimatorOptions(), pose_graph, reconstruction, [])
    return reconstruction, time.perf_counter() - start
