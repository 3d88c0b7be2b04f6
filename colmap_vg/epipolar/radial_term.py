"""Estimation of one radial distortion term for cameras with free focal length, if it lowers the epipolar cost.

Unmodelled distortion is absorbed by the focal length and scene curvature: along a street these three form a valley of
the cost in which bundle adjustment converges very slowly. In the epipolar adjustment the term is one more unknown of
the normal equations, beside poses and focal lengths.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import MAX_RADIAL_TERM, AdjustmentResult, adjust_epipolar
from colmap_vg.epipolar.problem import EpipolarProblem

BoolArray = NDArray[np.bool_]

MIN_COST_REDUCTION = 0.01
"""Least share of the cost that the term must save; smaller reductions are noise."""
_TOLERANCE = 1e-4
"""Relative change of the cost at which the adjustment ends, a hundredth of the reduction that it looks for."""


@dataclass(frozen=True, eq=False)
class RadialFit:
    """The problem with a radial term among its unknowns, and the cameras adjusted to it."""

    problem: EpipolarProblem
    result: AdjustmentResult


def fit_radial_term(problem: EpipolarProblem, start: AdjustmentResult, bent_cameras: BoolArray) -> RadialFit | None:
    """Estimate a radial term; None if it does not reduce the epipolar cost by `MIN_COST_REDUCTION`.

    Parameters
    ----------
    problem : EpipolarProblem
    start : AdjustmentResult
        Result of the adjustment without the term.
    bent_cameras : (c,) bool array
        Cameras that the term applies to; their focal lengths are free.

    Returns
    -------
    RadialFit or None
        Adjusted at the Cauchy scale of `start`, to the edges that `start` kept. The problem has all edges.
    """
    bent = replace(problem, bent_cameras=bent_cameras)
    kept = bent.without(start.reversed_edges) if start.reversed_edges.any() else bent
    cameras = start.cameras
    found = adjust_epipolar(
        kept,
        cameras.rotations,
        cameras.centers,
        cameras.relative(kept.edges)[1],  # so that no edge is dropped, and the costs are comparable
        initial_lenses=cameras.lenses,
        scales_px=(start.scale_px,),
        final_sigmas=0.0,
        near=True,
        tolerance=_TOLERANCE,
    )
    diverged = abs(found.radial_term) > MAX_RADIAL_TERM or bool(np.any(found.lost_focals & ~start.lost_focals))
    if diverged or found.cost > (1.0 - MIN_COST_REDUCTION) * start.cost:
        return None
    return RadialFit(bent, found)
