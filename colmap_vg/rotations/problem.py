"""Input checks and result type shared by all rotation-averaging solvers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.errors import GraphError
from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RotationResult:
    """Absolute rotations with convergence information. They are determined up to a common rotation Q, ``R_i Q``.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    cost : float
        Objective of the solver at these rotations.
    num_iterations : int
    converged : bool
        Whether the step fell below the tolerance before the iteration limit.
    log : tuple of LogEntry
        One entry for each iteration; `change` is the size of the step, radians.
    """

    cam_from_world_rotations: Array
    cost: float
    num_iterations: int
    converged: bool
    log: tuple[LogEntry, ...]


def checked_problem(
    num_images: int, edges: ArrayLike, rotations: ArrayLike, weights: ArrayLike | None
) -> tuple[IntArray, Array, Array]:
    """Convert edges, relative rotations and weights to arrays and check that they determine all rotations.

    Edges of weight zero are treated as absent.

    Raises
    ------
    GraphError
        Shapes differ, rows are out of range or link an image to itself, values are not finite, a weight is negative, or
        the edges of positive weight do not connect the graph.
    """
    edges = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    R = np.asarray(rotations, dtype=np.float64)
    if R.shape != (len(edges), 3, 3):
        raise GraphError(f"rotation averaging: relative rotations have shape {R.shape}, expected ({len(edges)}, 3, 3)")
    w = np.ones(len(edges)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(edges),):
        raise GraphError(f"rotation averaging: weights have shape {w.shape}, expected ({len(edges)},)")
    if num_images < 1:
        raise GraphError(f"rotation averaging: needs at least one image, found {num_images}")
    if len(edges) and (edges.min() < 0 or edges.max() >= num_images):
        raise GraphError(f"rotation averaging: edges have rows {edges.min()} to {edges.max()} of {num_images} images")
    if (edges[:, 0] == edges[:, 1]).any():
        row = int(np.flatnonzero(edges[:, 0] == edges[:, 1])[0])
        raise GraphError(f"rotation averaging: edge {row} links image row {edges[row, 0]} to itself")
    bad = ~(np.isfinite(R).all(axis=(1, 2)) & np.isfinite(w)) | (w < 0)
    if bad.any():
        raise GraphError(
            f"rotation averaging: edge {np.flatnonzero(bad)[0]} has a rotation that is not finite, or a weight that is "
            f"negative or not finite ({bad.sum()} such edges)"
        )
    component = components_by_size(num_images, edges[w > 0])
    if component.max() > 0:
        cut = np.flatnonzero(component > 0)
        shown = ", ".join(map(str, cut[:5])) + (", ..." if len(cut) > 5 else "")
        raise GraphError(
            f"rotation averaging: the graph is disconnected, {component.max() + 1} components; image rows {shown} "
            "are not connected to the largest one: solve each component separately"
        )
    return edges, R, w


def checked_initial(num_images: int, initial: ArrayLike | None) -> Array | None:
    """Copy and check initial rotations; None stays None.

    Raises
    ------
    GraphError
        The shape is not (n, 3, 3), or a value is not finite.
    """
    if initial is None:
        return None
    R = np.array(initial, dtype=np.float64)
    if R.shape != (num_images, 3, 3) or not np.isfinite(R).all():
        raise GraphError(f"rotation averaging: initial rotations must be finite ({num_images}, 3, 3), found {R.shape}")
    return R
