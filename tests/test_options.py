"""Options are checked when they are made."""

import pytest

from colmap_vg import ColmapVgError, MappingOptions, ReadOptions, SolveOptions


def test_defaults_hold_and_are_frozen():
    options = MappingOptions()
    assert options.solve.method == "epipolar"
    with pytest.raises(AttributeError):
        options.num_threads = 3


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: SolveOptions(method="3C"), "choose one of epipolar"),
        (lambda: SolveOptions(rotation_gate_deg=-1.0), "outside its range"),
        (lambda: SolveOptions(max_num_iterations=2.5), "integer"),
        (lambda: SolveOptions(accelerate=1), "True or False"),
        (lambda: ReadOptions(min_num_inliers=True), "number"),
        (lambda: ReadOptions(min_num_inliers=1), "outside its range 5"),
        (lambda: SolveOptions(convergence_tolerance=float("nan")), "outside its range"),
    ],
)
def test_bad_values_are_named(make, complaint):
    with pytest.raises(ColmapVgError, match=complaint):
        make()
