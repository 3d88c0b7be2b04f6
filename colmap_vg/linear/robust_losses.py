"""Robust losses, and their weights for iteratively reweighted least squares.

Each function takes squared residuals divided by the squared scale. Weights are ``rho'(s)``, so that the weighted
problem has the gradient of ``0.5 sum rho(r^2)``.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EFFICIENT_CAUCHY = 2.385
"""Cauchy scale over standard deviation for 95 % efficiency under normal noise (Holland & Welsch 1977)."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


def geman_mcclure_weight(s: Array) -> Array:
    """Geman-McClure weight ``1 / (1 + s)^2``, for the loss ``rho(s) = s / (1 + s)``."""
    return np.asarray(1.0 / np.square(1.0 + s))


def cauchy_weight(s: Array) -> Array:
    """Cauchy weight ``1 / (1 + s)``, for the loss ``rho(s) = log(1 + s)``."""
    return np.asarray(1.0 / (1.0 + s))


def cauchy_loss(s: Array) -> Array:
    """Cauchy loss ``rho(s) = log(1 + s)``."""
    return np.log1p(s)
