"""Each flag reaches the option that it stands for, under every name that it has."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import get_type_hints

import pytest
from typer.testing import CliRunner

import colmap_vg.cli
from colmap_vg.cli.flags import FeatureFlags, JobFlags, ModelFlags, ReadFlags, SolveFlags
from colmap_vg.cli.main import app
from colmap_vg.errors import MappingError
from colmap_vg.options import FeatureOptions, MappingOptions, SolveOptions


class Jobs(SimpleNamespace):
    """Stands in for `colmap_vg.cli.jobs`, and keeps what it is called with."""

    def run(self, *arguments: object) -> None:
        self.called = arguments

    mapper = solve = demo = run


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Jobs:
    jobs = Jobs()
    monkeypatch.setitem(sys.modules, "colmap_vg.cli.jobs", jobs)
    monkeypatch.setattr(colmap_vg.cli, "jobs", jobs, raising=False)
    return jobs


def called(jobs: Jobs, *arguments: str) -> tuple[object, ...]:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    found: tuple[object, ...] = jobs.called
    return found


def mapping(jobs: Jobs, *flags: str) -> MappingOptions:
    options = called(jobs, "mapper", "--database_path", "d", "--output_path", "o", *flags)[3]
    assert isinstance(options, MappingOptions)
    return options


def test_no_flags_are_the_librarys_defaults(jobs: Jobs) -> None:
    assert mapping(jobs) == MappingOptions()
    image_path, output_path, features, options, resume, *_ = called(
        jobs, "run", "--image_path", "i", "--output_path", "o"
    )
    assert (image_path, output_path, resume) == (Path("i"), Path("o"), False)
    assert features == FeatureOptions()
    assert options == MappingOptions()
    assert called(jobs, "solve", "--database_path", "d", "--output_path", "o")[3] == SolveOptions()


@pytest.mark.parametrize("prefix", ["--", "--Mapper.", "--GlobalMapper."])
def test_refinement_flags(jobs: Jobs, prefix: str) -> None:
    options = mapping(jobs, f"{prefix}ba_refine_focal_length", "0")
    assert not options.ba_refine_focal_length
    assert options.solve.refine_focal_lengths == "never"
    assert mapping(jobs, f"{prefix}ba_refine_principal_point=true").ba_refine_principal_point
    assert not mapping(jobs, f"{prefix}ba_refine_extra_params", "False").ba_refine_extra_params


def test_glomaps_refinement_flags(jobs: Jobs) -> None:
    options = mapping(jobs, "--BundleAdjustment.optimize_intrinsics", "0")
    assert not options.ba_refine_focal_length
    assert not options.ba_refine_extra_params
    assert mapping(jobs, "--BundleAdjustment.optimize_principal_point", "1").ba_refine_principal_point


@pytest.mark.parametrize("prefix", ["--", "--Mapper.", "--GlobalMapper."])
def test_threads_seed_and_matches_reach_every_stage(jobs: Jobs, prefix: str) -> None:
    options = mapping(jobs, f"{prefix}num_threads", "3", f"{prefix}random_seed", "7", f"{prefix}min_num_matches", "20")
    assert options.num_threads == 3
    assert options.random_seed == options.read.random_seed == options.solve.random_seed == 7
    assert options.read.min_num_inliers == 20
    assert mapping(jobs, f"{prefix}random_seed", "-1").random_seed == 0


def test_solver_flags(jobs: Jobs) -> None:
    flags = ("--method", "2C", "--rotation_averaging", "chordal", "--outlier_filter", "1dsfm", "--edge_weights", "unit")
    options = mapping(jobs, *flags, "--rotation_gate_deg", "0", "--Mapper.extract_colors", "0", "--overwrite")
    expected = SolveOptions(
        method="2C", rotation_averaging="chordal", outlier_filter="1dsfm", edge_weights="unit", rotation_gate_deg=0.0
    )
    assert options.solve == expected
    assert not options.extract_colors
    assert options.share_cameras
    assert not mapping(jobs, "--share_cameras", "0").share_cameras
    assert options.overwrite
    assert mapping(jobs, "--GlobalMapper.ra_max_rotation_error_deg", "5").solve.rotation_gate_deg == 5.0
    assert mapping(jobs, "--trust_focal_lengths", "never").read.trust_focal_lengths == "never"


def test_feature_flags(jobs: Jobs) -> None:
    flags = ("--camera_model", "PINHOLE", "--camera_params", "1,2.5,3,4", "--camera_mode", "single")
    more = (
        "--matching",
        "sequential",
        "--mask_path",
        "m",
        "--image_list_path",
        "l",
        "--max_num_features",
        "99",
        "--resume",
    )
    arguments = called(jobs, "run", "--image_path", "i", "--output_path", "o", *flags, *more)
    assert arguments[2] == FeatureOptions(
        camera_model="PINHOLE",
        camera_params=(1.0, 2.5, 3.0, 4.0),
        camera_mode="single",
        matching="sequential",
        mask_path=Path("m"),
        image_list_path=Path("l"),
        max_num_features=99,
    )
    assert arguments[4] is True


def test_quality_sets_what_is_not_given(jobs: Jobs) -> None:
    def features(*flags: str) -> tuple[int, int]:
        options = called(jobs, "run", "--image_path", "i", "--output_path", "o", *flags)[2]
        return options.max_image_size, options.max_num_features

    assert features() == features("--quality", "high") == (-1, 8192)
    assert features("--quality", "low") == (1000, 2048)
    assert features("--quality", "low", "--max_num_features", "99") == (1000, 99)
    assert features("--max_image_size", "500", "--quality", "extreme") == (500, 16384)


def features(jobs: Jobs, *flags: str) -> FeatureOptions:
    options = called(jobs, "run", "--image_path", "i", "--output_path", "o", *flags)[2]
    assert isinstance(options, FeatureOptions)
    return options


def test_quality_stands_for_features_and_explicit_flags_win(jobs: Jobs) -> None:
    assert features(jobs, "--quality", "high") == FeatureOptions()
    for quality in ("low", "medium", "extreme"):
        assert features(jobs, "--quality", quality) == FeatureOptions.of_quality(quality) != FeatureOptions()
    low = FeatureOptions.of_quality("low")
    assert features(jobs, "--quality", "low", "--max_num_features", "8192").max_num_features == 8192
    assert features(jobs, "--quality", "low", "--max_num_features", "8192").max_image_size == low.max_image_size
    assert features(jobs, "--max_image_size", "-1", "--quality", "low").max_image_size == -1
    assert features(jobs, "--quality", "extreme", "--matching", "auto").matching == "auto"
    assert features(jobs, "--matching", "sequential", "--sequential_overlap", "3").sequential_overlap == 3


def test_unknown_quality_and_matching_are_usage_errors(jobs: Jobs) -> None:
    for flags, words in ((("--quality", "best"), "'low', 'medium'"), (("--matching", "tree"), "selected")):
        result = CliRunner().invoke(app, ["run", "--image_path", "i", "--output_path", "o", *flags])
        assert result.exit_code == 2
        assert words in result.output


def test_values_that_are_no_switch_or_number_are_usage_errors() -> None:
    for flag, value, words in (("--covariances", "maybe", "0, 1, true"), ("--camera_params", "1,f", "separated by")):
        result = CliRunner().invoke(app, ["run", "--image_path", "i", "--output_path", "o", flag, value])
        assert result.exit_code == 2
        assert flag in result.output
        assert words in result.output


def test_every_flag_of_a_group_is_in_the_help_of_its_verbs() -> None:
    for verb, groups in (
        ("run", (FeatureFlags, SolveFlags, ReadFlags, ModelFlags, JobFlags)),
        ("mapper", (SolveFlags, ReadFlags, ModelFlags, JobFlags)),
        ("solve", (SolveFlags, ReadFlags, JobFlags)),
        ("demo", (JobFlags,)),
    ):
        shown = CliRunner().invoke(app, [verb, "--help"]).output
        for group in groups:
            for name, hint in get_type_hints(group, include_extras=True).items():
                option = hint.__metadata__[0]
                assert option.default in shown, (verb, group, name)
                assert option.help, (group, name)


def test_demo_flags(jobs: Jobs) -> None:
    assert called(jobs, "demo", "--output_path", "o")[:3] == (Path("o"), 24, 0)
    assert called(jobs, "demo", "--output_path", "o", "--num_images", "6", "--seed", "5")[:3] == (Path("o"), 6, 5)


def test_ends_of_a_job_become_exit_codes(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    def end_with(error: BaseException) -> tuple[int, str]:
        def job(*_: object) -> None:
            raise error

        monkeypatch.setattr(jobs, "solve", job, raising=False)
        result = CliRunner().invoke(app, ["solve", "--database_path", "d", "--output_path", "o"])
        return result.exit_code, result.stderr

    assert end_with(MappingError("no model\ncould be made")) == (1, "error: no model could be made\n")
    code, line = end_with(KeyboardInterrupt())
    assert code == 130
    assert line.startswith("interrupted")
