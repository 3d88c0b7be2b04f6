"""What a viewing-graph solve returns: poses, and a verdict for every image and edge."""

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
        The solver that wrote it: ``rotations``, ``cls``, ``2O``, ``epipolar``, ...
    iteration : int
    cost : float
        The stage's own objective.
    change : float
        Relative change on which the stage's convergence is judged.
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
        Share of the inlier matches that are in pairs whose direction is within three standard deviations; a degree for
        what the lens model leaves is in them.
    num_pairs : int
        Pairs between images of the component that have a rotation of their own.
    """

    inliers: float
    pairs: float
    directions: float
    num_pairs: int


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Poses of all images of a graph, in the graph's order; rows of unsolved images hold NaN.

    Images that nothing links firmly are solved in several components, each in a frame of its own.

    Attributes
    ----------
    image_ids : (n,) int64 array
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        Camera centres in the component's frame; centroid 0, root mean square distance 1 over its images.
    registered : (n,) bool array
        Images of component 0, the largest: those that share a frame with most others.
    component : (n,) int64 array
        Component each image belongs to, numbered by size; -1 where unsolved.
    focal_scales : (c,) array
        Factor on each camera's focal length in the graph.
    radial_terms : (c,) array or None
        Radial term found for each camera, as in COLMAP's polynomials and at the focal length found, on top of what
        the camera had. None where none was worth having.
    position_covariances : (n, 3, 3) array or None
        Of the centres, in their component's frame and unit after the best similarity; where asked for.
    rotation_covariances : (n, 3, 3) array or None
        Of small turns w of each camera in its own frame, ``R <- exp(w) R``, squared radians; where asked for.
    edge_residual_sigmas : (m,) array or None
        Root mean square of the whitened differences of each edge's relative pose from the solution's, about 1 under
        the noise of its matches alone; NaN where the edge has no information or its images share no component.
    edge_kept : (m,) bool array
    edge_verdicts : (m,) str array
        `EdgeVerdict` words.
    image_verdicts : (n,) str array
        `ImageVerdict` words.
    status : SolutionStatus
    message : str
        A sentence that says what happened and what to do.
    converged : bool
        Whether no iteration limit was reached.
    caveats : tuple of str
        Sentences on what could not be had in full.
    agreement : tuple of Agreement
        Of each component with its pairs.
    in_doubt : (n,) bool array or None
        Images that another arrangement, with which nearly as many matches agree, places otherwise; None without one.
    arrangements : tuple of (n, 3, 3) arrays
        cam_from_world rotations, as averaged, of the arrangement that was solved and of others worth a look: that one,
        and the one that each image's strongest pairs make. NaN outside the part that they arrange. Empty where there
        are no others.
    log : tuple of LogEntry
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
    arrangements: tuple[Array, ...] = ()
    log: tuple[LogEntry, ...] = field(default=())
