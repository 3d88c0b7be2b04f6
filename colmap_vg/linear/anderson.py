"""Anderson acceleration of a fixed-point iteration (type II, Walker & Ni 2011), with a safeguard."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class AndersonMixer:
    """Anderson acceleration of ``x <- g(x)`` from the last few points and images.

    The caller applies ``g`` to the proposed point, so that the fixed points are those of the plain iteration. If the
    residual ``||g(x) - x||`` exceeds the best one by more than `max_growth`, the memory is cleared and the plain step
    is taken.

    Acceleration also suppresses modes that the plain iteration amplifies on its way to a distant fixed point, and can
    stay near a repelling point. Therefore, if the residual has not halved in `patience` proposals, plain steps follow
    until it has decreased to a tenth.

    Parameters
    ----------
    depth : int
        Number of differences in memory.
    max_growth : float
        Largest ratio of the residual to the best one, dimensionless.
    patience : int
        Number of proposals in which the residual must halve.
    """

    def __init__(self, depth: int = 8, max_growth: float = 2.0, patience: int = 20) -> None:
        self._depth, self._max_growth, self._patience = depth, max_growth, patience
        self._images: list[Array] = []
        self._residuals: list[Array] = []
        self._best = np.inf
        self._goal, self._since, self._plain_above = np.inf, 0, np.inf

    def propose(self, x: Array, image: Array) -> Array:
        """Propose the next point after ``image = g(x)``; all arrays are flat."""
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
    """Iterate ``x <- step(x)`` until the relative change of x in a plain step is at most `tolerance`.

    Parameters
    ----------
    step : callable
        Takes and returns an array of x's shape.
    x : array
        Initial point.
    accelerate : bool
        Whether to use Anderson acceleration; convergence is judged on the plain step.
    max_num_iterations : int
    tolerance : float
        Limit of ``||step(x) - x|| / ||x||`` at convergence.
    on_iteration : callable
        Called with the iteration, ``step(x)`` and its relative change.

    Returns
    -------
    x : array
        Image ``step(x)`` of the last point.
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
