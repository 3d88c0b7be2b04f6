"""One radial term of the lenses whose focal length is free, where the data ask for it.

A lens that bends, taken for one that does not, is paid for by its focal length and by a bend of the whole scene: along
a street these three form a valley that bundle adjustment hardly descends. The epipolar cost is minimised over the
cameras at a few values of the term, which is taken out of the rays; a parabola through the best three gives the next.
The term is COLMAP's: a point at normalised coordinates u is shown at ``u (1 + k |u|^2)``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.adjustment import AdjustmentResult, Cameras, adjust_epipolar
from colmap_vg.epipolar.problem import EpipolarProblem

BoolArray = NDArray[np.bool_]

FIRST_STEP, MAX_TERM = 0.06, 0.6
"""Of the term, at the focal lengths of the problem."""
NUM_REFINEMENTS = 2
"""Parabolas, each on a quarter of the last one's step."""
WORTH_IT = 0.01
"""Share of the cost that the term must save; less is noise."""


@dataclass(frozen=True, eq=False)
class RadialFit:
    """A radial term, the problem with rays freed of it, and its cameras."""

    radial_term: float
    problem: EpipolarProblem
    result: AdjustmentResult


def fit_radial_term(problem: EpipolarProblem, start: AdjustmentResult, bendable: BoolArray) -> RadialFit | None:
    """The radial term of least epipolar cost, where that saves a share of the cost worth having.

    Parameters
    ----------
    problem : EpipolarProblem
    start : AdjustmentResult
        Of that problem.
    bendable : (c,) bool array
        Cameras whose rays may take it.

    Returns
    -------
    RadialFit or None
        Adjusted at the start's Cauchy scale, with no edge left out.
    """
    tried: dict[float, AdjustmentResult] = {}

    def cost(term: float) -> float:
        if term not in tried:
            nearest = tried[min(tried, key=lambda t: abs(t - term))] if tried else start
            tried[term] = _adjusted(problem.straightened(term, bendable), nearest, start.scale_px)
        return tried[term].cost

    center, step = 0.0, FIRST_STEP
    for _ in range(NUM_REFINEMENTS):
        while abs(center) + step <= MAX_TERM and min(cost(center - step), cost(center + step)) < cost(center):
            center += step if cost(center + step) < cost(center - step) else -step
        if abs(center) + step > MAX_TERM:
            return None
        low, middle, high = (cost(center + side * step) for side in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        vertex = center + (0.5 * step * (low - high) / bend if bend > 0.0 else 0.0)
        center = vertex if cost(vertex) < middle else center
        step /= 4.0
    if cost(center) > (1.0 - WORTH_IT) * cost(0.0):
        return None
    return RadialFit(center, problem.straightened(center, bendable), tried[center])


def _adjusted(problem: EpipolarProblem, start: AdjustmentResult, scale_px: float) -> AdjustmentResult:
    """At one scale; directions are the start's own, so that no edge leaves and costs compare."""
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
