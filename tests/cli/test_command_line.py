"""The command line as a user meets it: exit codes, one line per error, files in the output folder, nothing else."""

import hashlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rendered_corner import render_corner
from typer.testing import CliRunner, Result

from colmap_vg import __version__
from colmap_vg.cli.main import app

COMMAND = [sys.executable, "-m", "colmap_vg"]


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten images of 150 points with half a pixel of noise, made by pycolmap's own generator."""
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 10, 150
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_PINHOLE
    options.camera_params = [1280.0, 512.0, 384.0]
    options.camera_has_prior_focal_length = True
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    with pycolmap.Database.open(path) as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, model, database)
    return path


@pytest.fixture(scope="module")
def images_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corner") / "images"
    render_corner(6).write(folder)
    return folder


def assert_user_error(result: Result, *words: str) -> None:
    assert result.exit_code == 1, result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]


def summary(output_path: Path) -> dict[str, object]:
    content = json.loads((output_path / "summary.json").read_text(encoding="utf-8"))
    assert content["version"] == __version__
    assert content["stages"]
    for stage in content["stages"]:
        assert stage["seconds"] >= 0.0
        assert stage["peak_memory_mib"] > 1.0
    return content


# Usage: exit 2


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "--no_such_flag"],
        ["run", "--image_path", "a"],
        ["run", "--image_path", "a", "--output_path", "b", "--camera_mode", "shared"],
        ["run", "--image_path", "a", "--output_path", "b", "--matching", "vocabulary"],
        ["run", "--image_path", "a", "--output_path", "b", "--camera_params", "a,b"],
        ["run", "--image_path", "a", "--output_path", "b", "--Mapper.max_num_models", "1"],
        ["mapper", "--database_path", "a", "--output_path", "b", "--Mapper.no_such_flag", "1"],
        ["mapper", "--database_path", "a", "--output_path", "b", "--Mapper.ba_refine_focal_length", "2"],
        ["mapper", "--database_path", "a", "--output_path", "b", "--method", "3C"],
        ["mapper", "--database_path", "a", "--output_path", "b", "--rotation_gate_deg", "200"],
        ["mapper", "--database_path", "a", "--output_path", "b", "--num_threads", "many"],
        ["mapper", "--database_path", "a", "--output_path", "b", "stray"],
        ["solve", "--database_path", "a", "--output_path", "b", "--quiet", "--verbose"],
        ["demo", "--output_path", "b", "--num_images", "2"],
        ["no_such_verb"],
    ],
)
def test_wrong_usage_ends_with_2(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert "Error" in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


def test_help_and_version() -> None:
    assert invoke("--version").output.strip() == f"colmap-vg {__version__}"
    for verb in ("run", "mapper", "solve", "demo"):
        text = invoke(verb, "--help").output
        for flag in (
            "--output_path",
            "--overwrite",
            "--resume",
            "--quiet",
            "--verbose",
            "--num_threads",
            "--random_seed",
        ):
            assert flag in text, (verb, flag)
    assert "--Mapper.ba_refine_focal_length" in invoke("mapper", "--help").output


# What a user or the data caused: exit 1, one line, nothing written


@pytest.mark.parametrize("verb", ["mapper", "solve"])
@pytest.mark.parametrize("kind", ["missing", "empty", "text", "folder", "unverified"])
def test_a_bad_database_is_one_clear_line(tmp_path: Path, verb: str, kind: str) -> None:
    path, output = tmp_path / "database.db", tmp_path / "out"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("this is no database\n" * 50)
    elif kind == "folder":
        path.mkdir()
    elif kind == "unverified":
        pycolmap.Database.open(path).close()
    before = path.read_bytes() if path.is_file() else None
    assert_user_error(invoke(verb, "--database_path", path, "--output_path", output), "database")
    assert (path.read_bytes() if path.is_file() else None) == before
    assert path.exists() == (kind != "missing")
    assert not list(output.glob("[0-9]*"))
    assert not (output / "summary.json").exists()


@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_an_output_below_a_file_is_refused(tmp_path: Path, database_path: Path, verb: str) -> None:
    (tmp_path / "file").write_text("")
    result = invoke(verb, "--database_path", database_path, "--output_path", tmp_path / "file" / "out")
    assert_user_error(result, "output", "file")


@pytest.mark.parametrize("verb", ["run", "mapper", "solve"])
def test_a_model_is_not_overwritten_unasked(tmp_path: Path, database_path: Path, images_path: Path, verb: str) -> None:
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "cameras.bin").write_text("a user's model")
    source = ["--image_path", images_path] if verb == "run" else ["--database_path", database_path]
    assert_user_error(invoke(verb, *source, "--output_path", tmp_path), "--overwrite")
    assert (tmp_path / "0" / "cameras.bin").read_text() == "a user's model"


def test_bad_photographs_are_one_clear_line(tmp_path: Path, images_path: Path) -> None:
    output = tmp_path / "out"
    assert_user_error(invoke("run", "--image_path", tmp_path / "gone", "--output_path", output), "no such image folder")
    (tmp_path / "images").mkdir()
    assert_user_error(invoke("run", "--image_path", tmp_path / "images", "--output_path", output), "no photograph")
    for name in ("00.jpg", "01.jpg"):
        (tmp_path / "images" / name).write_bytes((images_path / name).read_bytes())
    result = invoke("run", "--image_path", tmp_path / "images", "--output_path", output)
    assert_user_error(result, "2 photographs", "at least 3")
    assert not output.exists()


# What works


def test_mapper_writes_a_model_and_a_summary(tmp_path: Path, database_path: Path) -> None:
    before = hashlib.sha256(database_path.read_bytes()).hexdigest()
    flags = ["--Mapper.ba_refine_focal_length", "0", "--Mapper.num_threads", "2"]
    ignored = ["--Mapper.max_num_models", "3", "--GlobalMapper.gp_use_gpu=0", "--skip_pruning", "1"]
    result = invoke("mapper", "--database_path", database_path, "--output_path", tmp_path, *flags, *ignored)
    assert result.exit_code == 0, result.output
    assert hashlib.sha256(database_path.read_bytes()).hexdigest() == before
    assert result.stderr == ""
    model = pycolmap.Reconstruction(tmp_path / "0")
    assert model.num_reg_images() == 10
    assert model.num_points3D() > 100
    assert {camera.params[0] for camera in model.cameras.values()} == {1280.0}
    content = summary(tmp_path)
    assert content["images"]["num_registered"] == 10
    assert content["edges"]["num_kept"] == 45
    named = " ".join(content["warnings"])
    for flag in ("--Mapper.max_num_models", "--GlobalMapper.gp_use_gpu", "--skip_pruning"):
        assert flag in named
        assert flag in result.stdout
    assert content["options"]["mapping"]["ba_refine_focal_length"] is False


def test_quiet_is_quiet_and_overwrite_overwrites(tmp_path: Path, database_path: Path) -> None:
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "cameras.bin").write_text("an old model")
    result = invoke(
        "mapper", "--database_path", database_path, "--output_path", tmp_path, "--quiet", "--overwrite",
        "--num_threads", 2, "--Mapper.max_num_models", 3,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert result.output == ""
    assert pycolmap.Reconstruction(tmp_path / "0").num_reg_images() == 10
    assert "--Mapper.max_num_models" in summary(tmp_path)["warnings"][0]


def test_solve_writes_poses_without_points(tmp_path: Path, database_path: Path) -> None:
    result = invoke("solve", "--database_path", database_path, "--output_path", tmp_path, "--method", "2C")
    assert result.exit_code == 0, result.output
    model = pycolmap.Reconstruction(tmp_path / "0")
    assert model.num_reg_images() == 10
    assert model.num_points3D() == 0
    centers = np.array([model.images[index].projection_center() for index in sorted(model.images)])
    assert np.all(np.isfinite(centers))
    content = summary(tmp_path)
    assert content["images"]["num_registered"] == 10
    assert content["images"]["left_out"] == {}
    assert content["edges"]["num_edges"] == 45


def test_run_goes_from_photographs_to_a_model(tmp_path: Path, images_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for path in images_path.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "broken.jpg").write_bytes((folder / "00.jpg").read_bytes()[:3000])
    result = invoke(
        "run", "--image_path", folder, "--output_path", tmp_path / "out", "--camera_model", "PINHOLE",
        "--camera_params", "450,450,240,180", "--camera_mode", "single", "--num_threads", 2, "--max_num_features", 2000,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "database.db").is_file()
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert model.num_reg_images() == 6
    content = summary(tmp_path / "out")
    assert content["images"]["num_registered"] == 6
    assert "truncated" in content["images"]["left_out"]["broken.jpg"]
    assert {"photographs", "features", "matching"} <= {stage["stage"] for stage in content["stages"]}


def test_ctrl_c_ends_with_130_and_leaves_no_model(tmp_path: Path, images_path: Path) -> None:
    arguments = ["run", "--image_path", images_path, "--output_path", tmp_path / "out", "--verbose"]
    with subprocess.Popen(
        [*COMMAND, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        for line in process.stdout:
            if line.startswith("features: started"):
                process.send_signal(signal.SIGINT)
                break
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "--resume" in errors.splitlines()[-1]
    assert not (tmp_path / "out" / "0").exists()
    assert not (tmp_path / "out" / "database.db").exists()
