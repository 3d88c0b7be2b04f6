"""The options with which jobs solve a graph before bundle adjustment."""

import pytest

from colmap_vg.jobs.graph import TOLERANCE_BEFORE_POINTS, solve_options
from colmap_vg.options import MappingOptions, SolveOptions


@pytest.mark.parametrize(("given", "used"), [(1e-5, TOLERANCE_BEFORE_POINTS), (0.1, 0.1)])
def test_the_epipolar_adjustment_may_be_rough_before_bundle_adjustment(given: float, used: float) -> None:
    options = MappingOptions(solve=SolveOptions(adjustment_tolerance=given, method="2C"), random_seed=7)
    assert solve_options(options) == SolveOptions(adjustment_tolerance=used, method="2C", random_seed=7)


def test_focal_lengths_that_bundle_adjustment_keeps_are_kept() -> None:
    assert solve_options(MappingOptions(ba_refine_focal_length=False)).refine_focal_lengths == "never"
    assert solve_options(MappingOptions()).refine_focal_lengths == "auto"
