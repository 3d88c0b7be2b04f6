"""Result type and input checks shared by all position solvers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PositionResult:
    """Positions solved at known rotations, with convergence information.

    Attributes
    ----------
    projection_centers : (n, 3) array
        World frame, centroid 0; the scale depends on the solver.
    lambdas : (m,) array
        Scale factor of each edge as defined by the solver; its length if the solver has none.
    cost : float
        Objective of the solver.
    num_iterations : int
    converged : bool
    log : tuple of LogEntry
        One entry per iteration.
    """

    projection_centers: Array
    lambdas: Array
    cost: float
    num_iterations: int
    converged: bool
    log: tuple[LogEntry, ...]


def check_connected(num_images: int, edges: IntArray) -> None:
    """Check that the graph is connected.

    Raises
    ------
    GraphError
        Some image is not connected to the others.
    """
    component = components_by_size(num_images, edges)
    if num_images and component.max() > 0:
        row = int(np.flatnonzero(component)[0])
        raise GraphError(
            f"positions need a connected graph: image row {row} is not connected to the"
            f" {int((component == 0).sum())} images of the largest component; solve each component separately"
        )


def unit_weights(weights: Array | None, num_edges: int) -> Array:
    """Weights (m,) as floats; all one if None."""
    return np.ones(num_edges) if weights is None else np.asarray(weights, dtype=float)


def centered(p: Array) -> Array:
    """Positions with centroid 0."""
    return np.asarray(p - p.mean(axis=0))


def spread(p: Array) -> float:
    """``sqrt(sum ||p||^2)`` of centred positions."""
    return float(np.linalg.norm(p))
