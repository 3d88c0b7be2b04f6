"""Jobs that are killed, interrupted, started twice or resumed: whole models only, and the same result in the end.

``COLMAP_VG_NUM_KILLS`` sets how many random moments of `run` are tried; the default keeps the suite short.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pycolmap
import pytest
from rendered_corner import render_corner
from synthetic_databases import make_database, sha256

pytestmark = pytest.mark.slow

NUM_KILLS = int(os.environ.get("COLMAP_VG_NUM_KILLS", "2"))
SMALL = ["--max_num_features", "300", "--max_image_size", "240", "--num_threads", "1", "--verbose"]
MODEL_FILES = {"cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"}


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "colmap_vg", *map(str, arguments)]


def hearing_ctrl_c() -> None:
    """Shells start what runs in the background deaf to it, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(*arguments: object) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hearing_ctrl_c
    )


def finish(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False, timeout=120)


def kill_at(line: str, *arguments: object, with_signal: int = signal.SIGKILL) -> tuple[int, str]:
    """Start a job, send the signal when it says a line, and return its exit code and errors."""
    with start(*arguments) as process:
        for said in process.stdout:
            if said.startswith(line):
                process.send_signal(with_signal)
                break
        _, errors = process.communicate(timeout=60)
    return process.returncode, errors


def registered(model_path: Path) -> set[str]:
    model = pycolmap.Reconstruction(model_path)
    return {model.image(image_id).name for image_id in model.reg_image_ids()}


def assert_whole_models_only(output: Path, images: set[str]) -> None:
    for folder in output.glob("[0-9]*"):
        assert {path.name for path in folder.iterdir()} == MODEL_FILES
        assert registered(folder) == images


@pytest.fixture(scope="module")
def images_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corner") / "images"
    render_corner(4).write(folder)
    return folder


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, images_path: Path) -> tuple[Path, float]:
    """The output of a run that nothing disturbed, and its seconds."""
    output = tmp_path_factory.mktemp("undisturbed") / "out"
    began = time.monotonic()
    done = finish("run", "--image_path", images_path, "--output_path", output, *SMALL)
    assert done.returncode == 0, done.stderr
    return output, time.monotonic() - began


@pytest.mark.parametrize("seed", range(NUM_KILLS))
def test_a_run_killed_anywhere_ends_as_if_undisturbed(
    tmp_path: Path, images_path: Path, undisturbed: tuple[Path, float], seed: int
) -> None:
    """Spread over the run: one moment in each of as many equal parts of it as there are kills."""
    expected, seconds = registered(undisturbed[0] / "0"), undisturbed[1]
    arguments = ["run", "--image_path", images_path, "--output_path", tmp_path / "out", *SMALL]
    process = start(*arguments)
    time.sleep(seconds * (seed + random.Random(seed).random()) / NUM_KILLS)
    process.kill()
    process.communicate(timeout=60)
    assert_whole_models_only(tmp_path / "out", expected)
    resumed = finish(*arguments, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert_whole_models_only(tmp_path / "out", expected)
    assert registered(tmp_path / "out" / "0") == expected == {path.name for path in images_path.iterdir()}
    assert (tmp_path / "out" / "summary.json").is_file()


@pytest.mark.parametrize("stage", ["features", "matching", "adjust"])
def test_ctrl_c_in_any_stage_is_130_and_keeps_what_is_done(
    tmp_path: Path, images_path: Path, undisturbed: tuple[Path, float], stage: str
) -> None:
    arguments = ["run", "--image_path", images_path, "--output_path", tmp_path / "out", *SMALL]
    code, errors = kill_at(f"{stage}: started", *arguments, with_signal=signal.SIGINT)
    assert code == 130, errors
    assert "Traceback" not in errors
    assert errors.splitlines()[-1] == "interrupted; finished stages are kept: go on with --resume"
    assert not (tmp_path / "out" / "0").exists()
    resumed = finish(*arguments, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    done = [line.split(":")[0] for line in resumed.stdout.splitlines() if line.endswith(": started")]
    assert ("features" in done) == (stage in ("features", "matching"))
    assert registered(tmp_path / "out" / "0") == registered(undisturbed[0] / "0")


def test_one_camera_of_all_images_survives_a_kill(tmp_path: Path, images_path: Path) -> None:
    """COLMAP finds the shared camera while it reads the images: half of them must not get another one."""
    arguments = ["run", "--image_path", images_path, "--output_path", tmp_path / "out", "--camera_mode", "single"]
    kill_at("features: 0 of", *arguments, *SMALL)
    resumed = finish(*arguments, *SMALL, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert pycolmap.Reconstruction(tmp_path / "out" / "0").num_cameras() == 1


def test_a_finished_job_has_nothing_left_to_do(undisturbed: tuple[Path, float], images_path: Path) -> None:
    output = undisturbed[0]
    before = {path: sha256(path) for path in output.rglob("*") if path.is_file()}
    again = finish("run", "--image_path", images_path, "--output_path", output, *SMALL, "--resume")
    assert again.returncode == 0, again.stderr
    assert "nothing is left to do" in again.stdout
    other = finish("run", "--image_path", images_path, "--output_path", output, *SMALL, "--resume", "--method", "2O")
    assert other.returncode == 1
    assert "--overwrite" in other.stderr
    assert {path: sha256(path) for path in output.rglob("*") if path.is_file()} == before


def test_two_jobs_on_one_output_refuse_each_other(tmp_path: Path, images_path: Path) -> None:
    arguments = ["run", "--image_path", images_path, "--output_path", tmp_path / "out", *SMALL]
    make_database(tmp_path / "database.db", num_images=4, num_points=60)
    with start(*arguments) as first:
        for line in first.stdout:
            if line.startswith("features: started"):
                first.send_signal(signal.SIGSTOP)  # for as long as the others try
                break
        try:
            for other in (arguments, ["mapper", "--database_path", tmp_path / "database.db", *arguments[3:5]]):
                refused = finish(*other)
                assert refused.returncode == 1
                lines = refused.stderr.splitlines()
                assert len(lines) == 1, lines
                assert f"process {first.pid}" in lines[0]
                assert "choose another --output_path" in lines[0]
        finally:
            first.send_signal(signal.SIGCONT)
        _, errors = first.communicate(timeout=60)
    assert first.returncode == 0, errors
    assert not (tmp_path / "out" / ".work" / "lock").exists()


@pytest.mark.parametrize(("verb", "stage"), [("mapper", "solve"), ("mapper", "write"), ("solve", "write")])
def test_other_verbs_leave_no_half_model_either(tmp_path: Path, verb: str, stage: str) -> None:
    make_database(tmp_path / "database.db", num_images=6, num_points=150, noise_px=0.3)
    before = sha256(tmp_path / "database.db")
    arguments = [verb, "--database_path", tmp_path / "database.db", "--output_path", tmp_path / "out", "--verbose"]
    kill_at(f"{stage}: started", *arguments)
    if (tmp_path / "out" / "0").exists():
        assert {path.name for path in (tmp_path / "out" / "0").iterdir()} == MODEL_FILES
    resumed = finish(*arguments, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert len(registered(tmp_path / "out" / "0")) == 6
    assert sha256(tmp_path / "database.db") == before
    assert {path.name for path in (tmp_path / "out" / ".work").iterdir()} == {"job.json"}


def test_a_demo_goes_on_with_its_photographs(tmp_path: Path) -> None:
    arguments = ["demo", "--output_path", tmp_path, "--num_images", 4, "--num_threads", 1, "--verbose"]
    kill_at("features: started", *arguments)
    photographs = {path.name: sha256(path) for path in (tmp_path / "images").iterdir()}
    assert len(photographs) == 4
    with start(*arguments, "--resume") as process:
        said = [line for line in process.stdout if line.endswith(": started\n")]
    assert process.returncode == 0
    assert "render: started\n" not in said
    assert {path.name: sha256(path) for path in (tmp_path / "images").iterdir()} == photographs


@pytest.mark.parametrize("inside", ["model", "."])
def test_a_finished_job_in_its_image_folder_is_finished(tmp_path: Path, inside: str) -> None:
    """What a job writes beside its photographs does not make it another job, nor does it become a photograph."""
    render_corner(4).write(tmp_path)
    arguments = ["run", "--image_path", tmp_path, "--output_path", tmp_path / inside, *SMALL]
    first = finish(*arguments)
    assert first.returncode == 0, first.stderr
    assert "skipped" not in first.stdout + first.stderr
    again = finish(*arguments, "--resume")
    assert again.returncode == 0, again.stderr
    assert "nothing is left to do" in again.stdout
    (tmp_path / "00.jpg").unlink()
    assert "already holds a model" in finish(*arguments, "--resume").stderr
