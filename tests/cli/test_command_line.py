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
from synthetic_databases import DAMAGES, changed_copy, make_database, sha256, two_view_tracks_only
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


@pytest.fixture(scope="module")
def small_database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images that see the same 60 points."""
    path = tmp_path_factory.mktemp("small") / "database.db"
    make_database(path, num_images=4, num_points=60)
    return path


def assert_refused(verb: str, path: Path, output: Path, *words: str) -> None:
    """One line that names the words, nothing written, nothing changed."""
    before = {p.name: sha256(p) for p in path.parent.iterdir() if p.is_file()}
    assert_user_error(invoke(verb, "--database_path", path, "--output_path", output), *words)
    assert {p.name: sha256(p) for p in path.parent.iterdir() if p.is_file()} == before
    assert not output.exists()


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
        ["run", "--image_path", "a", "--output_path", "b", "--quality", "best"],
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
@pytest.mark.parametrize("kind", ["missing", "empty", "text", "folder", "new"])
def test_a_bad_database_is_one_clear_line(tmp_path: Path, verb: str, kind: str) -> None:
    path = tmp_path / "database.db"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("this is no database\n" * 50)
    elif kind == "folder":
        path.mkdir()
    elif kind == "new":
        pycolmap.Database.open(path).close()
    assert_refused(verb, path, tmp_path / "out", "database")
    assert path.exists() == (kind != "missing")


@pytest.mark.parametrize("verb", ["mapper", "solve"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_database_is_one_clear_line(
    tmp_path: Path, small_database_path: Path, verb: str, damage: str
) -> None:
    statements, words = DAMAGES[damage]
    path = changed_copy(small_database_path, tmp_path / "database.db", *statements)
    assert_refused(verb, path, tmp_path / "new" / "out", str(path), *words)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_a_database_without_verified_pairs_says_what_to_do(
    tmp_path: Path, small_database_path: Path, verb: str
) -> None:
    path = changed_copy(small_database_path, tmp_path / "database.db", "DELETE FROM two_view_geometries")
    assert_refused(verb, path, tmp_path / "out", "4 images", "no verified pairs", "match them first")


@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_a_rig_is_mapped_with_its_frames(tmp_path: Path, verb: str) -> None:
    make_database(tmp_path / "database.db", num_images=8, num_points=80, num_cameras_per_rig=2)
    job = [verb, "--database_path", str(tmp_path / "database.db"), "--output_path", str(tmp_path / "out")]
    result = CliRunner().invoke(app, job)
    assert result.exit_code == 0, result.output
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert model.num_reg_frames() == 4
    assert model.num_reg_images() == 8


@pytest.mark.parametrize("verb", ["mapper", "solve"])
@pytest.mark.parametrize(("num_images", "num_points"), [(2, 60), (4, 12)])
def test_too_few_images_or_matches_say_what_to_do(tmp_path: Path, verb: str, num_images: int, num_points: int) -> None:
    make_database(tmp_path / "database.db", num_images=num_images, num_points=num_points)
    assert_refused(verb, tmp_path / "database.db", tmp_path / "out", "No three images", "add overlapping photographs")


def test_an_error_after_colmaps_own_work_is_still_the_only_line(tmp_path: Path) -> None:
    """In a process of its own: what C++ writes to standard error passes CliRunner by."""
    make_database(tmp_path / "database.db", num_images=4, num_points=200, noise_px=0.3)
    for image_id in range(1, 5):
        two_view_tracks_only(tmp_path / "database.db", image_id)
    arguments = ["mapper", "--database_path", tmp_path / "database.db", "--output_path", tmp_path / "out"]
    done = subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1
    assert "add overlapping photographs" in done.stderr
    assert not (tmp_path / "out").exists()


def test_missing_photographs_cost_the_colours_only(
    tmp_path: Path, small_database_path: Path, images_path: Path
) -> None:
    """`--image_path` names a folder without them, or one that is not there."""
    for folder in (images_path, tmp_path / "nowhere"):
        output = tmp_path / folder.name
        result = invoke(
            "mapper", "--database_path", small_database_path, "--output_path", output, "--image_path", folder
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        assert result.stderr == ""
        model = pycolmap.Reconstruction(output / "0")
        assert model.num_reg_images() == 4
        assert all((point.color == 0).all() for point in model.points3D.values())
        caveats = [line for line in summary(output)["warnings"] if "4 of 4 registered images are missing in" in line]
        assert len(caveats) == 1
        assert str(folder) in caveats[0]


@pytest.mark.real_data
@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_an_old_database_is_not_migrated(tmp_path: Path, data_folder: Path, verb: str) -> None:
    """Stored poses are identity and zero, cameras are COLMAP's guesses, the schema is an older one."""
    path = tmp_path / "source" / "database.db"
    path.parent.mkdir()
    path.write_bytes((data_folder / "databases" / "untrusted_relative_poses.db").read_bytes())
    before = sha256(path)
    result = invoke(verb, "--database_path", path, "--output_path", tmp_path / "out", "--num_threads", 2)
    assert result.exit_code == 0, result.output
    assert sha256(path) == before
    assert list(path.parent.iterdir()) == [path]
    content = summary(tmp_path / "out")
    assert content["images"]["num_images"] == 30


@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_an_output_below_a_file_is_refused(tmp_path: Path, database_path: Path, verb: str) -> None:
    (tmp_path / "file").write_text("")
    before = sha256(database_path)
    result = invoke(verb, "--database_path", database_path, "--output_path", tmp_path / "file" / "out")
    assert_user_error(result, "output", "file")
    assert sha256(database_path) == before
    assert (tmp_path / "file").read_text() == ""


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
    assert content["status"] == "solved"
    assert content["models"][0]["agreement"] == {"inliers": 1.0, "pairs": 1.0, "directions": 1.0, "num_pairs": 45}
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
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells start what runs in the background deaf to Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
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


def test_a_finished_job_explains_itself(database_path: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert invoke("mapper", "--database_path", database_path, "--output_path", output).exit_code == 0
    names = [image.name for image in pycolmap.Reconstruction(output / "0").images.values()]
    result = invoke("explain", "--output_path", output)
    assert result.exit_code == 0
    assert "model 0: 10 images" in result.output
    result = invoke("explain", "--output_path", output, "--image", names[0])
    assert result.exit_code == 0
    assert "registered" in result.output
    result = invoke("explain", "--output_path", output, "--pair", names[0], names[1])
    assert "verified matches" in result.output
    result = invoke("explain", "--output_path", output, "--image", "nobody.jpg")
    assert result.exit_code == 1
    assert "error: no image" in result.stderr
    assert invoke("explain", "--output_path", output, "--image", "a", "--pair", "a", "b").exit_code == 2
    assert invoke("explain", "--output_path", tmp_path).exit_code == 1


def test_a_long_flag_with_one_dash_is_wrong_usage() -> None:
    done = subprocess.run([*COMMAND, "mapper", "-database_path", "x"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "did you mean --database_path?" in done.stderr
