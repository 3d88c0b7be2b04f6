"""The options with which jobs solve a graph before bundle adjustment."""

from dataclasses import replace

import pytest

from colmap_vg.jobs.graph import (
    MATCHES_BEFORE_POINTS,
    TOLERANCE_BEFORE_POINTS,
    TRACKS_BEFORE_POINTS,
    read_options,
    solve_options,
)
from colmap_vg.options import MappingOptions, ReadOptions, SolveOptions

ROUGH = SolveOptions(
    adjustment_tolerance=TOLERANCE_BEFORE_POINTS,
    max_matches_per_edge=MATCHES_BEFORE_POINTS,
    max_tracks_per_triplet=TRACKS_BEFORE_POINTS,
)


@pytest.mark.parametrize(
    ("given", "used"),
    [
        ({}, {}),
        ({"adjustment_tolerance": 0.1}, {"adjustment_tolerance": 0.1}),
        ({"max_matches_per_edge": 0, "max_tracks_per_triplet": 0}, {}),
        ({"max_matches_per_edge": 17, "max_tracks_per_triplet": 3},) * 2,
    ],
)
def test_the_epipolar_adjustment_may_be_rough_before_bundle_adjustment(
    given: dict[str, float], used: dict[str, float]
) -> None:
    options = MappingOptions(solve=SolveOptions(method="2C", **given), random_seed=7)
    assert solve_options(options) == replace(ROUGH, method="2C", random_seed=7, **used)


@pytest.mark.parametrize(("given", "used"), [(1000, MATCHES_BEFORE_POINTS), (60, 60)])
def test_poses_of_pairs_may_be_rough_before_bundle_adjustment(given: int, used: int) -> None:
    read = read_options(MappingOptions(read=ReadOptions(max_matches_per_pose=given, min_num_inliers=20)))
    assert read == ReadOptions(max_matches_per_pose=used, min_num_inliers=20)


def test_focal_lengths_that_bundle_adjustment_keeps_are_kept() -> None:
    assert solve_options(MappingOptions(ba_refine_focal_length=False)).refine_focal_lengths == "never"
    assert solve_options(MappingOptions()).refine_focal_lengths == "auto"
