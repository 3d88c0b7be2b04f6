"""Anderson acceleration of a fixed-point iteration (type II, Walker & Ni 2011), with a safeguard."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class AndersonMixer:
    """Proposes the next point of ``x <- g(x)`` from the last few points and images.

    The proposal is only a guess: the caller iterates ``g`` on it, so the fixed point is the plain iteration's own. When
    the residual ``||g(x) - x||`` grows by more than `max_growth` over the best one, the memory is thrown away and the
    plain step is taken.

    A mode that the plain iteration lets grow on its way to a far fixed point looks to the mixer like one to be undone:
    it would hold the iteration near a point that repels. So, where the residual has not halved in `patience` proposals,
    plain steps follow until it is a tenth.

    Parameters
    ----------
    depth : int
        Differences remembered.
    max_growth : float
    patience : int
    """

    def __init__(self, depth: int = 8, max_growth: float = 2.0, patience: int = 20) -> None:
        self._depth, self._max_growth, self._patience = depth, max_growth, patience
        self._images: list[Array] = []
        self._residuals: list[Array] = []
        self._best = np.inf
        self._goal, self._since, self._plain_above = np.inf, 0, np.inf

    def propose(self, x: Array, image: Array) -> Array:
        """Next point after ``image = g(x)``, flat arrays."""
        residual = image - x
        norm = float(np.linalg.norm(residual))
        if norm > self._plain_above:
            return image
        self._since += 1
        if norm < self._goal:
            self._goal, self._since = 0.5 * norm, 0
        elif self._since > self._patience:
            self._images, self._residuals, self._best = [], [], np.inf
            self._goal, self._since, self._plain_above = np.inf, 0, 0.1 * norm
            return image
        if norm > self._max_growth * self._best:
            self._images, self._residuals = [], []
        self._best = min(self._best, norm)
        self._images.append(image)
        self._residuals.append(residual)
        if len(self._residuals) > self._depth + 1:
            self._images.pop(0)
            self._residuals.pop(0)
        if len(self._residuals) < 2:
            return image
        F = np.stack([b - a for a, b in zip(self._residuals[:-1], self._residuals[1:], strict=True)], axis=1)
        G = np.stack([b - a for a, b in zip(self._images[:-1], self._images[1:], strict=True)], axis=1)
        gamma, *_ = np.linalg.lstsq(F, residual, rcond=1e-10)
        return np.asarray(image - G @ gamma)


def fixed_point(
    step: Callable[[Array], Array],
    x: Array,
    *,
    accelerate: bool,
    max_num_iterations: int,
    tolerance: float,
    on_iteration: Callable[[int, Array, float], None],
) -> tuple[Array, int, bool]:
    """Iterate ``x <- step(x)`` until the plain step changes x by at most `tolerance`, relative.

    Parameters
    ----------
    step : callable
        Takes and returns an array of x's shape.
    x : array
    accelerate : bool
        Anderson acceleration; the test of convergence stays the plain step's.
    max_num_iterations : int
    tolerance : float
        On ``||step(x) - x|| / ||x||``.
    on_iteration : callable
        Told the iteration, ``step(x)`` and its relative change.

    Returns
    -------
    x : array
        ``step`` of the last point.
    num_iterations : int
    converged : bool
    """
    mixer = AndersonMixer()
    image = x
    for iteration in range(1, max_num_iterations + 1):
        image = step(x)
        change = float(np.linalg.norm(image - x) / max(float(np.linalg.norm(x)), np.finfo(float).tiny))
        on_iteration(iteration, image, change)
        if change <= tolerance:
            return image, iteration, True
        x = mixer.propose(x.ravel(), image.ravel()).reshape(x.shape) if accelerate else image
    return image, max_num_iterations, False
