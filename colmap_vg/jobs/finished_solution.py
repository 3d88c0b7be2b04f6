"""The solution of a job as its finished models have it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import focal_length
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.mapping.build import BuildResult
from colmap_vg.mapping.weak_cuts import WeakCut
from colmap_vg.scene.edge_residuals import graph_residual_sigmas
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict, SolutionStatus
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.agreement import pair_agreement
from colmap_vg.solver.state import described


def solution_of_models(
    solution: PoseSolution,
    graph: ViewGraph,
    models: "Sequence[pycolmap.Reconstruction]",
    results: Sequence[BuildResult],
    cuts: Sequence[Sequence[WeakCut]],
) -> PoseSolution:
    """Update a solution with the poses, focal lengths and image verdicts of the finished models.

    Parameters
    ----------
    solution : PoseSolution
        As solved, before triangulation and bundle adjustment.
    graph : ViewGraph
    models : sequence of pycolmap.Reconstruction
        The largest first.
    results : sequence of BuildResult
        Of each model.
    cuts : sequence of sequences of WeakCut
        Weak cuts of each model; images of contradicted ones are in doubt.

    Returns
    -------
    PoseSolution
        Its residuals and agreement are those of the models; radial terms stay as solved.
    """
    words = solution.image_verdicts.astype(object)
    words[solution.component >= 0] = ImageVerdict.FEW_OBSERVATIONS
    misplaced = sorted(set().union(*(result.misplaced for result in results)))
    words[np.isin(solution.image_ids, misplaced)] = ImageVerdict.MISPLACED
    component = np.full(len(words), -1)
    rotations = np.full_like(solution.cam_from_world_rotations, np.nan)
    centers = np.full_like(solution.projection_centers, np.nan)
    focal_scales = solution.focal_scales.copy()
    for index in reversed(range(len(models))):
        model = models[index]
        for row in np.flatnonzero(np.isin(solution.image_ids, sorted(model.reg_image_ids()))):
            image = model.image(int(solution.image_ids[row]))
            component[row] = index
            words[row] = ImageVerdict.REGISTERED if index == 0 else ImageVerdict.OTHER_MODEL
            rotations[row] = image.cam_from_world().rotation.matrix()
            centers[row] = image.projection_center()
        focal_scales = _focal_scales(focal_scales, graph, model)
    agreement = pair_agreement(graph, rotations, centers, component)
    contradicted = sorted(set().union(*(cut.images for of_model in cuts for cut in of_model if cut.contradicted)))
    in_doubt = solution.in_doubt
    if contradicted:
        in_doubt = (False if in_doubt is None else in_doubt) | np.isin(solution.image_ids, contradicted)
    doubtful = in_doubt is not None or any(result.folded for result in results)
    status, message = described(words, solution.converged, agreement, doubtful, solution.uncertain is not None)
    return replace(
        solution,
        position_covariances=_covariances_in_models(solution, centers, component),
        cam_from_world_rotations=rotations,
        projection_centers=centers,
        registered=component == 0,
        component=component,
        focal_scales=focal_scales,
        image_verdicts=words.astype(str),
        status=status,
        message=message,
        edge_residual_sigmas=graph_residual_sigmas(graph, rotations, centers, component),
        agreement=agreement,
        in_doubt=in_doubt,
    )


def solution_of_reading(graph: ViewGraph) -> PoseSolution:
    """A solution without poses: verdicts of a graph's edges from reading, and of images by whether they have edges."""
    n, has_edges = graph.num_images, np.zeros(graph.num_images, dtype=bool)
    has_edges[graph.edges[graph.has_rotation]] = True
    return PoseSolution(
        image_ids=graph.image_ids,
        cam_from_world_rotations=np.full((n, 3, 3), np.nan),
        projection_centers=np.full((n, 3), np.nan),
        registered=np.zeros(n, dtype=bool),
        component=np.full(n, -1),
        focal_scales=np.ones(0 if graph.camera_ids is None else len(graph.camera_ids)),
        edge_kept=graph.has_rotation,
        edge_verdicts=np.full(graph.num_edges, str(EdgeVerdict.KEPT))
        if graph.read_verdicts is None
        else graph.read_verdicts,
        image_verdicts=np.where(has_edges, str(ImageVerdict.FEW_OBSERVATIONS), str(ImageVerdict.NO_EDGES)),
        status=SolutionStatus.PARTIAL,
        message="",
    )


def with_edges_of_models(solution: PoseSolution, graph: ViewGraph) -> PoseSolution:
    """The solution with the edges as not used that leave its models."""
    ends = solution.component[graph.edges]
    outside = solution.edge_kept & ((ends[:, 0] != ends[:, 1]) | (ends[:, 0] < 0))
    verdicts = np.where(outside, str(EdgeVerdict.OUTSIDE), solution.edge_verdicts)
    return replace(solution, edge_verdicts=verdicts, edge_kept=solution.edge_kept & ~outside)


def _covariances_in_models(
    solution: PoseSolution, centers: NDArray[np.float64], component: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Position covariances in the frames of the models (n, 3, 3); NaN for images that were registered by points."""
    if solution.position_covariances is None:
        return None
    covariances = np.full_like(solution.position_covariances, np.nan)
    for model in range(int(component.max(initial=-1)) + 1):
        rows = np.flatnonzero((component == model) & np.isfinite(solution.projection_centers).all(axis=1))
        if len(rows) >= 3:
            _, similarity = align_positions(solution.projection_centers[rows], centers[rows])
            turned = similarity.rotation @ solution.position_covariances[rows] @ similarity.rotation.T
            covariances[rows] = similarity.scale**2 * turned
    return covariances


def _focal_scales(
    scales: NDArray[np.float64], graph: ViewGraph, model: "pycolmap.Reconstruction"
) -> NDArray[np.float64]:
    """Update the factors on the graph's focal lengths of the cameras that a model uses."""
    scales = scales.copy()
    if graph.camera_ids is not None and graph.camera_focal_lengths is not None:
        used = {model.image(i).camera_id for i in model.reg_image_ids()}
        for row, camera_id in enumerate(graph.camera_ids.tolist()):
            if camera_id in used:
                scales[row] = focal_length(model.camera(camera_id)) / graph.camera_focal_lengths[row]
    return scales
