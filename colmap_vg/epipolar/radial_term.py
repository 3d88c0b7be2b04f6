"""Estimation of one radial distortion term for cameras with free focal length, if it lowers the epipolar cost.

Unmodelled distortion is absorbed by the focal length and scene curvature: along a street these three form a valley of
the cost in which bundle adjustment converges very slowly. The epipolar cost is minimised over the cameras at a few
values of the term, with undistorted rays; a parabola through the best three values gives the next one. As in COLMAP's
models, a point at normalised coordinates u is imaged at ``u (1 + k |u|^2)``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import AdjustmentResult, Cameras, adjust_epipolar
from colmap_vg.epipolar.problem import EpipolarProblem

BoolArray = NDArray[np.bool_]

INITIAL_STEP, MAX_TERM = 0.06, 0.6
"""First step and largest absolute value of the term, dimensionless, at the focal lengths of the problem."""
NUM_REFINEMENTS = 2
"""Number of parabolas, each with a quarter of the previous step."""
MIN_COST_REDUCTION = 0.01
"""Least share of the cost that the term must save; smaller reductions are noise."""


@dataclass(frozen=True, eq=False)
class RadialFit:
    """A radial term, the problem with undistorted rays, and the cameras adjusted to it."""

    radial_term: float
    problem: EpipolarProblem
    result: AdjustmentResult


def fit_radial_term(problem: EpipolarProblem, start: AdjustmentResult, free_radials: BoolArray) -> RadialFit | None:
    """Estimate the radial term of least epipolar cost; None if it does not reduce the cost by `MIN_COST_REDUCTION`.

    Parameters
    ----------
    problem : EpipolarProblem
    start : AdjustmentResult
        Result of the adjustment without the term.
    free_radials : (c,) bool array
        Cameras that the term applies to.

    Returns
    -------
    RadialFit or None
        Adjusted at the Cauchy scale of `start`, with all edges.
    """
    tried: dict[float, AdjustmentResult] = {}

    def cost(term: float) -> float:
        if term not in tried:
            nearest = tried[min(tried, key=lambda t: abs(t - term))] if tried else start
            tried[term] = _adjusted(problem.undistorted(term, free_radials), nearest, start.scale_px)
        return tried[term].cost

    center, step = 0.0, INITIAL_STEP
    for _ in range(NUM_REFINEMENTS):
        while abs(center) + step <= MAX_TERM and min(cost(center - step), cost(center + step)) < cost(center):
            center += step if cost(center + step) < cost(center - step) else -step
        if abs(center) + step > MAX_TERM:
            return None
        low, middle, high = (cost(center + side * step) for side in (-1, 0, 1))
        curvature = low - 2.0 * middle + high
        vertex = center + (0.5 * step * (low - high) / curvature if curvature > 0.0 else 0.0)
        center = vertex if cost(vertex) < middle else center
        step /= 4.0
    if cost(center) > (1.0 - MIN_COST_REDUCTION) * cost(0.0):
        return None
    return RadialFit(center, problem.undistorted(center, free_radials), tried[center])


def _adjusted(problem: EpipolarProblem, start: AdjustmentResult, scale_px: float) -> AdjustmentResult:
    """Adjust at one scale with the directions of the start, so that no edge is dropped and costs are comparable."""
    cameras = Cameras(start.cam_from_world_rotations, start.projection_centers, np.log(start.focal_scales))
    return adjust_epipolar(
        problem,
        start.cam_from_world_rotations,
        start.projection_centers,
        cameras.relative(problem.edges)[1],
        initial_focal_scales=start.focal_scales,
        scales_px=(scale_px,),
        final_sigmas=0.0,
    )
