"""What every position solver returns."""

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
    """Positions at known rotations.

    Attributes
    ----------
    projection_centers : (n, 3) array
        Centroid 0; scale as the solver leaves it.
    lambdas : (m,) array
        The scale factor that the solver gives each edge; its length where the solver has none.
    cost : float
        The solver's own objective.
    num_iterations : int
    converged : bool
    log : tuple of LogEntry
    """

    projection_centers: Array
    lambdas: Array
    cost: float
    num_iterations: int
    converged: bool
    log: tuple[LogEntry, ...]


def check_connected(num_images: int, edges: IntArray) -> None:
    """Refuse graphs in which some image is not linked to the others.

    Raises
    ------
    GraphError
    """
    component = components_by_size(num_images, edges)
    if num_images and component.max() > 0:
        row = int(np.flatnonzero(component)[0])
        raise GraphError(
            f"positions need a connected graph: image row {row} is not linked to the"
            f" {int((component == 0).sum())} images of the largest component; solve the components one by one"
        )


def unit_weights(weights: Array | None, num_edges: int) -> Array:
    """Weights, 1 for each edge when none are given."""
    return np.ones(num_edges) if weights is None else np.asarray(weights, dtype=float)


def centered(p: Array) -> Array:
    """Positions with centroid 0."""
    return np.asarray(p - p.mean(axis=0))


def spread(p: Array) -> float:
    """``sqrt(sum ||p||^2)`` of centred positions."""
    return float(np.linalg.norm(p))
