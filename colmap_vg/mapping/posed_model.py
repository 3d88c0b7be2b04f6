"""Make reconstructions of poses from a solution; with rigs the poses of their frames and sensors, averaged."""

from dataclasses import replace

import pycolmap

from colmap_vg.colmap_io.reconstruction import reconstruction_from_solution
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.rig_poses import rig_poses_of_component


def posed_model(
    cache: "pycolmap.DatabaseCache", solution: PoseSolution, graph: ViewGraph, component: int = 0
) -> "pycolmap.Reconstruction":
    """Make a reconstruction with the poses of one component, without points.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
        Of the database that the graph was read from.
    solution : PoseSolution
    graph : ViewGraph
    component : int

    Returns
    -------
    pycolmap.Reconstruction
        See :func:`reconstruction_from_solution`.
    """
    rig_poses = None if graph.rigs is None else rig_poses_of_component(graph.rigs, solution, component)
    return reconstruction_from_solution(cache, solution, graph, component, rig_poses)


def with_placed_sensors(graph: ViewGraph, solution: PoseSolution) -> tuple[ViewGraph, int]:
    """Separate sensors from their rigs whose place is neither known nor told by the largest component.

    Parameters
    ----------
    graph : ViewGraph
    solution : PoseSolution

    Returns
    -------
    graph : ViewGraph
        With rigs whose sensors all have a place.
    num_separated : int
        Number of sensors that are rigs of their own now.
    """
    if graph.rigs is None:
        return graph, 0
    lost = ~(rig_poses_of_component(graph.rigs, solution, 0).posed_sensors | graph.rigs.known)
    if not lost.any():
        return graph, 0
    return replace(graph, rigs=graph.rigs.separate(lost)), int(lost.sum())


def scale_is_uncertain(graph: ViewGraph, solution: PoseSolution) -> bool:
    """Whether the graph has known distances between cameras of a rig, but these do not tell the model's scale."""
    if graph.rigs is None or not graph.rigs.is_metric:
        return False
    return not rig_poses_of_component(graph.rigs, solution, 0).scale_is_certain
