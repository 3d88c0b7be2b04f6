"""Result of a viewing-graph solve: poses, and a verdict for every image and edge."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from colmap_vg.scene.verdicts import SolutionStatus

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LogEntry:
    """One line of the iteration log.

    Attributes
    ----------
    stage : str
        Name of the solver: ``rotations``, ``cls``, ``2O``, ``epipolar``, ...
    iteration : int
    cost : float
        Objective of the stage.
    change : float
        Quantity on which the stage's convergence is judged, such as a relative change.
    """

    stage: str
    iteration: int
    cost: float
    change: float


@dataclass(frozen=True)
class Agreement:
    """Shares of a component's pairs, and of their inlier matches, that agree with its cameras.

    Attributes
    ----------
    inliers : float
        Share of the inlier matches that are in pairs within 5 degrees in rotation.
    pairs : float
        Share of the pairs within 5 degrees in rotation.
    directions : float
        Share of the inlier matches that are in pairs whose direction is within three standard deviations, which include
        one degree for unmodelled distortion.
    num_pairs : int
        Number of pairs between images of the component with a relative rotation.
    """

    inliers: float
    pairs: float
    directions: float
    num_pairs: int


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Poses of all images of a graph, in the graph's order; rows of unsolved images are NaN.

    Parts that are not reliably linked are solved as several components, each in its own frame.

    Attributes
    ----------
    image_ids : (n,) int64 array
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        Camera centres in the component's frame; centroid 0, root mean square distance 1 over its images.
    registered : (n,) bool array
        Images of component 0, the largest.
    component : (n,) int64 array
        Component of each image, numbered by decreasing size; -1 if unsolved.
    focal_scales : (c,) array
        Factor on each camera's focal length in the graph.
    radial_terms : (c,) array or None
        Radial term estimated for each camera, as in COLMAP's polynomials and at the estimated focal length, in addition
        to the camera's distortion. None if none was estimated.
    position_covariances : (n, 3, 3) array or None
        Covariances of the centres, in their component's frame and squared unit after the best similarity; only if
        requested.
    rotation_covariances : (n, 3, 3) array or None
        Covariances of small rotations w of each camera in its own frame, ``R <- exp(w) R``, squared radians; only if
        requested.
    edge_residual_sigmas : (m,) array or None
        Root mean square of the whitened differences of each edge's relative pose from the solution's; about 1 if the
        noise of its matches is the only error. NaN if the edge has no information or its images no common component.
    edge_kept : (m,) bool array
        Edges that were used in the solution.
    edge_verdicts : (m,) str array
        `EdgeVerdict` words.
    image_verdicts : (n,) str array
        `ImageVerdict` words.
    status : SolutionStatus
    message : str
        Sentences that say what happened and what to do.
    converged : bool
        Whether no iteration limit was reached.
    caveats : tuple of str
        Sentences on limitations of the solution.
    agreement : tuple of Agreement
        Agreement of each component with its pairs.
    in_doubt : (n,) bool array or None
        Images whose pose differs in another arrangement that as many matches, or nearly, agree with; None without one.
    uncertain : (n,) bool array or None
        Images of parts whose positions are hardly known, since the camera moved too little; None without any.
    arrangements : tuple of (n, 3, 3) arrays
        Averaged cam_from_world rotations of the solved arrangement and of alternatives: the one above, and the one from
        each image's strongest pairs. NaN outside the part concerned. Empty without alternatives.
    log : tuple of LogEntry
        One entry per iteration of each stage.
    """

    image_ids: NDArray[np.int64]
    cam_from_world_rotations: Array
    projection_centers: Array
    registered: NDArray[np.bool_]
    component: NDArray[np.int64]
    focal_scales: Array
    edge_kept: NDArray[np.bool_]
    edge_verdicts: NDArray[np.str_]
    image_verdicts: NDArray[np.str_]
    status: SolutionStatus
    message: str
    converged: bool = True
    caveats: tuple[str, ...] = ()
    radial_terms: Array | None = None
    position_covariances: Array | None = None
    rotation_covariances: Array | None = None
    edge_residual_sigmas: Array | None = None
    agreement: tuple[Agreement, ...] = ()
    in_doubt: NDArray[np.bool_] | None = None
    uncertain: NDArray[np.bool_] | None = None
    arrangements: tuple[Array, ...] = ()
    log: tuple[LogEntry, ...] = field(default=())
