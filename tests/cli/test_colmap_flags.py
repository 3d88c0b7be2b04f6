"""Flags of the other mappers are obeyed, named, or refused."""

from typing import Any

import pycolmap
import pytest

from colmap_vg.cli.colmap_flags import IGNORED, OBEYED, REFUSED, UnknownArgumentError, ignored_flags, parse_boolean


def field_names(options: Any) -> set[str]:
    nested = {name for name in dir(options) if not name.startswith("_") and hasattr(getattr(options, name), "todict")}
    return {name for name in options.todict() if name not in nested}


def test_every_option_of_pycolmaps_incremental_mapper_is_known() -> None:
    options = pycolmap.IncrementalPipelineOptions()
    names = {f"--Mapper.{name}" for name in field_names(options) | field_names(options.mapper)}
    names |= {f"--Mapper.tri_{name}" for name in field_names(options.triangulation)}
    not_flags = {"image_path", "image_names", "constant_rigs", "constant_cameras"}
    shared = {"min_focal_length_ratio", "max_focal_length_ratio", "max_extra_param", "random_seed"}
    names -= {f"--Mapper.{name}" for name in not_flags} | {f"--Mapper.tri_{name}" for name in shared}
    assert names <= IGNORED | set(OBEYED)


def test_every_option_of_pycolmaps_global_mapper_is_known() -> None:
    options = pycolmap.GlobalPipelineOptions()
    names = {f"--GlobalMapper.{name}" for name in field_names(options) | field_names(options.mapper)}
    names -= {"--GlobalMapper.image_path", "--GlobalMapper.image_names"}
    assert names <= IGNORED | set(OBEYED)


def test_no_flag_is_both_obeyed_and_ignored() -> None:
    assert not IGNORED.intersection(OBEYED)


@pytest.mark.parametrize("flag", REFUSED)
def test_flags_that_restrict_a_job_are_refused_unless_they_are_off(flag: str) -> None:
    assert flag in IGNORED
    for arguments in ([flag, "some.txt"], [f"{flag}=1"], [flag]):
        with pytest.raises(UnknownArgumentError, match=f"{flag} is not supported: (all|no|a) "):
            ignored_flags(arguments)
    assert ignored_flags([flag, "0"]) == [flag]


def test_values_are_taken_off() -> None:
    arguments = ["--Mapper.max_num_models", "3", "--constraint_type=ONLY_POINTS", "--Mapper.init_image_id1", "-1"]
    assert ignored_flags(arguments) == ["--Mapper.max_num_models", "--constraint_type", "--Mapper.init_image_id1"]
    assert ignored_flags(["--skip_pruning", "--log_level", "2"]) == ["--skip_pruning", "--log_level"]
    assert ignored_flags([]) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--Mapper.max_num_model", "3"], "did you mean --Mapper.max_num_models?"),
        (["--ba_refine_focal", "0"], "did you mean --ba_refine_focal_length?"),
        (["--Mapper.max_num_models", "3", "4"], "unexpected argument '4'"),
        (["-x"], "no such option: -x"),
    ],
)
def test_unknown_arguments_are_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(UnknownArgumentError, match=message.replace("?", r"\?")):
        ignored_flags(arguments)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0", False),
        ("1", True),
        ("true", True),
        ("False", False),
        ("TRUE", True),
        ("2", None),
        ("yes", None),
        ("", None),
    ],
)
def test_booleans_as_colmap_spells_them(text: str, value: bool | None) -> None:
    assert parse_boolean(text) is value
