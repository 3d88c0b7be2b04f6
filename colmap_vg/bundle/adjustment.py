"""Robust bundle adjustment: steps of poses and lenses, after each of which every point is refined alone.

The Cauchy loss is minimised by weights that bound it from above, so each step lowers the cost as far as the residuals
are linear, up to twice its length (Hunter & Lange, A tutorial on MM algorithms, 2004): steps are lengthened by the
ratio of the bound's curvature to the cost's, and where they go on in one direction. Points are eliminated from the
normal equations and refined after each step with the poses fixed, which keeps steps long where the points determine the
poses loosely (variable projection: Golub & Pereyra, Inverse Problems, 2003). A step that fails is corrected to second
order before it is damped, since the cost's valleys bend (Transtrum & Sethna, Improvements to the Levenberg-Marquardt
algorithm, 2012). It ends where a step is short in the unknowns' own standard deviations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.bundle.linearization import Linearization, linearize
from colmap_vg.bundle.point_systems import factored, gradients
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.bundle.reduced_system import ReducedPattern, ReducedSystem
from colmap_vg.events import report_progress
from colmap_vg.linear.solvers import SingularMatrixError
from colmap_vg.linear.threads import single_threaded_blas

Array = NDArray[np.float64]

TOLERANCE = 0.15
"""Root mean square of a step, in standard deviations of the unknowns, at which the adjustment ends."""
ROUGH_TOLERANCE = 0.5
"""The same where only the cost is asked for, or another round follows."""
MAX_NUM_STEPS = 40
"""Maximum number of steps."""
MAX_NUM_REFINEMENTS = 3
"""Maximum number of steps of the points after one of the poses. One suffices after most; where a valley of the cost is
narrow and bent, as that of a turntable's focal length, the points need more to follow a long step along it."""
WITHIN_REACH = 1.2
"""Cost after a step, over that before, above which points are not expected to make up for it."""
MIN_SHARE, MAX_SHARE = 0.3, 0.7
"""Share of a step in the one before, in the metric of their system, above which the next ones are expected to go on as
a geometric series, and the largest share that is believed: weights that change with residuals slow some directions."""
FIRST_DAMPING, MAX_DAMPING = 1e-8, 1e4
"""Damping after the first step that fails, and damping at which no step helps."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A result of bundle adjustment.

    Attributes
    ----------
    state : BundleState
    initial_cost, final_cost : float
        Robust costs, pixels squared.
    """

    state: BundleState
    initial_cost: float
    final_cost: float


@single_threaded_blas
def adjust(
    problem: BundleProblem,
    state: BundleState,
    loss_scale_px: float,
    *,
    tolerance: float = TOLERANCE,
) -> Adjusted:
    """Adjust poses, lenses and points.

    The gauge is free unless poses are held: it stays near the initial state's.

    Parameters
    ----------
    problem : BundleProblem
        With an observation at least.
    state : BundleState
        Initial values.
    loss_scale_px : float
        Scale of the Cauchy loss.
    tolerance : float
        Root mean square of a step, in standard deviations of the unknowns, at which the adjustment ends.

    Returns
    -------
    Adjusted
        Its cost is at most the initial one.
    """
    pattern, viewed = ReducedPattern(problem), state.viewed(problem)
    found = linearize(problem, state, loss_scale_px)
    initial_cost, damping, growth = found.cost, 0.0, 2.0
    state, found = _with_refined_points(problem, state, found, loss_scale_px)
    if not len(problem.free):
        return Adjusted(state, initial_cost, found.cost)
    system = ReducedSystem.of(problem, pattern, state, found)
    before: Array | None = None
    for count in range(MAX_NUM_STEPS):
        report_progress(f"bundle adjustment, step {count + 1}")
        try:
            step = system.step(damping)
        except SingularMatrixError:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > MAX_DAMPING:
                break
            continue
        expected = -float(system.gradient @ step)
        short = expected <= tolerance**2 * found.variance * len(problem.free)
        longer = _lengthening(system, before, step)
        before = step if longer == 1.0 else None
        step = longer * found.relaxation * step
        shifts = system.steps_of_points(problem, step, found.relaxation)
        trial = state.moved(problem, step, state.points + shifts, viewed)
        there = linearize(problem, trial, loss_scale_px)
        change = found.change_to(there)
        trial, there = _followed(problem, trial, there, loss_scale_px, found.cost)
        if there.cost >= found.cost:
            more, further = system.correction(problem, step, shifts, change, damping)
            trial = state.moved(problem, step + more, state.points + shifts + further, viewed)
            there = linearize(problem, trial, loss_scale_px)
            trial, there = _followed(problem, trial, there, loss_scale_px, found.cost)
        if there.cost < found.cost:
            gain = 2.0 * (found.cost - there.cost) / max(expected, np.finfo(np.float64).tiny)
            state, found, growth = trial, there, 2.0
            damping = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            damping = damping if damping > FIRST_DAMPING else 0.0
        else:
            damping, growth, before = max(growth * damping, FIRST_DAMPING), 2.0 * growth, None
        if short or damping > MAX_DAMPING:
            break
        if found is there:
            system = ReducedSystem.of(problem, pattern, state, found)
    return Adjusted(state, initial_cost, found.cost)


def _lengthening(system: ReducedSystem, before: Array | None, step: Array) -> float:
    """Factor of a step that goes on in the direction of the one before: the sum of the geometric series of both."""
    if before is None:
        return 1.0
    along = system.matrix @ before
    share = float(step @ along) / max(float(before @ along), np.finfo(np.float64).tiny)
    return 1.0 / (1.0 - min(share, MAX_SHARE)) if share > MIN_SHARE else 1.0


def _followed(
    problem: BundleProblem, trial: BundleState, there: Linearization, loss_scale_px: float, cost: float
) -> tuple[BundleState, Linearization]:
    """Let the points follow a step until it is below a cost, or too far above it."""
    for _ in range(MAX_NUM_REFINEMENTS):
        trial, there = _with_refined_points(problem, trial, there, loss_scale_px)
        if there.cost < cost or there.cost > WITHIN_REACH * cost:
            break
    return trial, there


def _with_refined_points(
    problem: BundleProblem, state: BundleState, found: Linearization, loss_scale_px: float
) -> tuple[BundleState, Linearization]:
    """Take a step of every point alone; points that lose by it stay."""
    q, rows, by_point = len(state.points), problem.point_row, found.by_moving_point(problem)
    factors = factored(q, rows, by_point)
    gradient = gradients(q, rows, by_point, found.residuals)
    points = state.points - found.relaxation * factors.upper(factors.lower(gradient)).T
    after = linearize(problem, BundleState(state.rotations, state.centers, points, state.parameters), loss_scale_px)
    worse = after.costs > found.costs
    if worse.any():
        points = np.where(worse[:, None], state.points, points)
        after = after.where(worse[rows], worse, found)
    return BundleState(state.rotations, state.centers, points, state.parameters), after
