"""Files of the output folder that were cut short: replaced where that is asked, otherwise named, never a traceback."""

import json
import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest
from rendered_corner import render_corner
from synthetic_databases import make_database

pytestmark = pytest.mark.slow

SMALL = ["--max_num_features", "300", "--max_image_size", "240", "--num_threads", "1"]


def job(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "colmap_vg", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def cut(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def as_if_killed(output: Path) -> None:
    """Mark a finished job as one that was killed after it had published its models."""
    record = output / ".work" / "job.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "finished": False}))


@pytest.mark.parametrize(("name", "share"), [("cameras.bin", 0.5), ("images.bin", 0.0), ("points3D.bin", 0.5)])
def test_a_model_file_cut_short_is_replaced(tmp_path: Path, name: str, share: float) -> None:
    make_database(tmp_path / "database.db", num_images=6, num_points=150, noise_px=0.3)
    output = tmp_path / "out"
    arguments = ["mapper", "--database_path", tmp_path / "database.db", "--output_path", output]
    assert job(*arguments).returncode == 0
    whole = {path.name: path.stat().st_size for path in (output / "0").iterdir()}
    for flag in ("--overwrite", "--resume"):
        cut(output / "0" / name, share)
        finished = job(*arguments, "--resume")  # it was, but is not whole any more
        assert finished.returncode == 1
        assert "replace it with --overwrite" in finished.stderr
        if flag == "--resume":
            as_if_killed(output)
        else:
            refused = job(*arguments)
            assert refused.returncode == 1
            assert refused.stderr.startswith("error: ")
            assert "replace it with --overwrite" in refused.stderr
        done = job(*arguments, flag)
        assert done.returncode == 0, done.stderr
        assert {path.name: path.stat().st_size for path in (output / "0").iterdir()} == whole
        assert pycolmap.Reconstruction(output / "0").num_reg_images() == 6


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_database_cut_short_is_named_and_made_anew_on_request(tmp_path: Path, share: float) -> None:
    render_corner(4).write(tmp_path / "images")
    output = tmp_path / "out"
    arguments = ["run", "--image_path", tmp_path / "images", "--output_path", output, *SMALL]
    assert job(*arguments).returncode == 0
    as_if_killed(output)
    cut(output / "database.db", share)
    refused = job(*arguments, "--resume")
    assert refused.returncode == 1
    (line,) = refused.stderr.splitlines()
    assert line.startswith(f"error: {output / 'database.db'} is damaged (")
    assert line.endswith("run again without --resume")
    done = job(*arguments, "--overwrite")
    assert done.returncode == 0, done.stderr
    assert pycolmap.Reconstruction(output / "0").num_reg_images() == 4


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_an_unfinished_database_cut_short_is_made_anew_by_resume(tmp_path: Path, share: float) -> None:
    render_corner(4).write(tmp_path / "images")
    output = tmp_path / "out"
    arguments = ["run", "--image_path", tmp_path / "images", "--output_path", output, *SMALL]
    assert job(*arguments).returncode == 0
    as_if_killed(output)
    unfinished = output / ".work" / "database.db"
    (output / "database.db").rename(unfinished)
    cut(unfinished, share)
    done = job(*arguments, "--resume")
    assert done.returncode == 0, done.stderr
    assert ("is damaged: features are extracted again" in done.stdout) == (share > 0.0)
    assert pycolmap.Reconstruction(output / "0").num_reg_images() == 4
