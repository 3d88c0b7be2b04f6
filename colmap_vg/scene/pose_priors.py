"""Measured positions and gravity of images, which constrain poses from outside of the photographs."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PosePriors:
    """Measured positions and gravity of n images; NaN where an image has none. Any of them may be wrong.

    Attributes
    ----------
    positions : (n, 3) array
        Projection centres: metres east, north and up of `origin` where there is one, else in the frame of whoever
        measured them.
    covariances : (n, 3, 3) array
        Of the positions; NaN where they are not known.
    gravities : (n, 3) array
        Unit vectors downwards, in the frame of each camera.
    origin : (float, float, float) or None
        Latitude and longitude in degrees and ellipsoidal height in metres (WGS84) of the origin.
    """

    positions: Array
    covariances: Array
    gravities: Array
    origin: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        n = len(self.positions)
        for name, shape in {"positions": (n, 3), "covariances": (n, 3, 3), "gravities": (n, 3)}.items():
            if getattr(self, name).shape != shape:
                raise GraphError(f"PosePriors.{name} has shape {getattr(self, name).shape}, expected {shape}")

    def without_positions(self) -> "PosePriors":
        """Gravity only."""
        return replace(
            self, positions=np.full_like(self.positions, np.nan), covariances=np.full_like(self.covariances, np.nan)
        )

    def with_sigmas(self, sigmas: tuple[float, float, float]) -> "PosePriors":
        """Priors with the same standard deviations of all positions, along the axes of their frame."""
        covariance = np.where(self.has_position[:, None, None], np.diag(np.square(sigmas)), np.nan)
        return replace(self, covariances=covariance)

    @property
    def has_position(self) -> BoolArray:
        """Mask (n,) of the images with a position."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def has_gravity(self) -> BoolArray:
        """Mask (n,) of the images with a direction of gravity."""
        return np.asarray(np.isfinite(self.gravities).all(axis=1))
