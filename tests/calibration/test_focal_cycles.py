"""The search of the focal length at which rotation cycles close best, on cost curves that are made for it."""

import numpy as np
import pytest

from colmap_vg.calibration import focal_cycles
from colmap_vg.calibration.focal_cycles import CyclePairs, CycleVote, vote_focal_by_rotation_cycles

PAIRS = CyclePairs(
    4, np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]), np.zeros((6, 2), dtype=int), *[np.zeros(0)] * 4
)


def vote(monkeypatch: pytest.MonkeyPatch, true_factor: float, valley: float, end: float, left_out: float) -> CycleVote:
    """Vote on a curve with a valley, and low costs at short focal lengths; fewer steps leave some in the valley."""

    def cost(
        pairs: CyclePairs, focal_x: np.ndarray, focal_y: np.ndarray, principal_points: np.ndarray, steps: int = 6
    ) -> float:
        away = np.log(focal_x[0] / true_factor)
        in_valley = valley * np.exp(-np.square(away / 0.3))
        to_the_end = end * np.exp(-np.square((np.log(focal_x[0]) - np.log(0.4)) / 0.6))
        return float(2000.0 - in_valley * (1.0 if steps >= 6 else 1.0 - left_out) - to_the_end)

    monkeypatch.setattr(focal_cycles, "_cycle_cost", cost)
    return vote_focal_by_rotation_cycles(PAIRS, np.ones(1), np.ones(1), np.zeros((1, 2)), np.ones(1, dtype=bool))


@pytest.mark.parametrize("true_factor", [0.8, 1.3, 2.4, 3.2])
def test_the_valley_is_found(true_factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    found = vote(monkeypatch, true_factor, 800.0, 0.0, 0.0)
    assert found.reliable
    assert found.factor == pytest.approx(true_factor, rel=0.01)


def test_a_minimum_that_few_steps_make_the_lowest_does_not_hide_the_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    found = vote(monkeypatch, 2.4, 800.0, 600.0, 0.4)
    assert found.reliable
    assert found.factor == pytest.approx(2.4, rel=0.01)


def test_a_lower_end_is_no_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not vote(monkeypatch, 2.4, 600.0, 800.0, 0.0).reliable


def test_minima_are_looked_at_if_they_are_nearly_the_lowest() -> None:
    x, y = np.arange(7.0), np.array([1.2, 1.5, 1.0, 1.4, 1.3, 1.35, 1.24])
    np.testing.assert_array_equal(focal_cycles._lowest_minima(x, y), [0.0, 2.0, 6.0])
