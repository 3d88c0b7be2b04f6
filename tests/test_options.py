"""Options are checked when they are made."""

import pytest

from colmap_vg import ColmapVgError, FeatureOptions, MappingOptions, ReadOptions, SolveOptions


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
        (lambda: FeatureOptions(matching="tree"), "choose one of auto, exhaustive, selected"),
        (lambda: FeatureOptions.of_quality("best"), "choose one of low, medium, high, extreme"),
        (lambda: FeatureOptions.of_quality("low", max_num_features=0), "outside its range 1"),
        (lambda: SolveOptions(convergence_tolerance=float("nan")), "outside its range"),
    ],
)
def test_bad_values_are_named(make, complaint):
    with pytest.raises(ColmapVgError, match=complaint):
        make()


def test_presets_grow_and_given_options_win():
    presets = [FeatureOptions.of_quality(quality) for quality in ("low", "medium", "high", "extreme")]
    counts = [preset.max_num_features for preset in presets]
    assert counts == sorted(set(counts))
    assert presets[2] == FeatureOptions()
    given = FeatureOptions.of_quality("low", max_image_size=500, matching="spatial", random_seed=3)
    assert given == FeatureOptions(max_image_size=500, max_num_features=counts[0], matching="spatial", random_seed=3)


@pytest.mark.parametrize("wrong", [{"overwrite": True}, SolveOptions(), 3])
def test_options_of_another_kind_are_named(wrong: object) -> None:
    with pytest.raises(ColmapVgError, match=f"must be a MappingOptions, found a {type(wrong).__name__}"):
        MappingOptions.given(wrong)  # type: ignore[arg-type]
    assert MappingOptions.given(None) == MappingOptions()
