"""What `ns-process-data images` writes, with our mapper: a script changes one path."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import nerfstudio_mapper
import numpy as np
import pycolmap
import pytest
from nerfstudio_mapper import main
from rendered_corner import write_jpeg

from colmap_vg.demo import render_photographs
from colmap_vg.errors import ColmapVgError, ImageFolderError, OutputError

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parents[2] / "pipelines" / "nerfstudio_mapper.py"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    render_photographs(folder, num_images=9)
    (folder / "more").mkdir()
    first = min(folder.glob("*.jpg"))
    first.rename(folder / "more" / "Z last.JPG")
    (folder / "notes.txt").write_text("no photograph")
    return folder


@pytest.fixture(scope="module")
def output(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerfstudio") / "data"
    command = [sys.executable, str(SCRIPT), "images", "--data", str(photographs), "--output-dir", str(out)]
    command += ["--matching-method", "exhaustive", "--num-downscales", "2", "--no-gpu", "--sfm-tool", "colmap"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "warning: --no-gpu has no counterpart" in done.stderr
    assert "warning: --sfm-tool has no counterpart" in done.stderr
    return out


def test_images_are_copied_and_halved(output: Path, photographs: Path) -> None:
    names = [f"frame_{number:05d}.jpg" for number in range(1, 10)]
    assert [path.name for path in sorted((output / "images").iterdir())] == names
    # In order of name, those of folders by their path.
    assert (output / "images" / names[8]).read_bytes() == (photographs / "more" / "Z last.JPG").read_bytes()
    whole = cv2.imread(str(output / "images" / names[3]))
    for factor in (2, 4):
        assert [path.name for path in sorted((output / f"images_{factor}").iterdir())] == names
        small = cv2.imread(str(output / f"images_{factor}" / names[3]))
        assert small.shape[:2] == (whole.shape[0] // factor, whole.shape[1] // factor)
        expected = cv2.resize(whole, small.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(float) - expected).mean() < 4.0
    assert not (output / "images_8").exists()
    assert [path.name for path in output.parent.iterdir()] == ["data"]


def test_transforms_are_those_of_the_model(output: Path) -> None:
    model = pycolmap.Reconstruction(output / "colmap" / "sparse" / "0")
    assert (output / "colmap" / "database.db").is_file()
    content = json.loads((output / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    assert (output / content["ply_file_path"]).is_file()
    assert len(content["frames"]) == model.num_reg_images() >= 8
    by_name = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    for frame in content["frames"]:
        assert (output / frame["file_path"]).is_file()
        assert frame["file_path"].startswith("images/")
        pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        expected = by_name[Path(frame["file_path"]).name].cam_from_world().inverse().matrix()
        np.testing.assert_allclose(pose[:3], expected, atol=1e-12)


def test_an_earlier_output_is_kept(output: Path, photographs: Path) -> None:
    before = (output / "transforms.json").stat().st_mtime_ns
    with pytest.raises(OutputError, match="is not empty"):
        main(photographs, output)
    assert (output / "transforms.json").stat().st_mtime_ns == before


def test_nothing_is_left_of_a_failed_job(tmp_path: Path) -> None:
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((64, 64, 3), 90, np.uint8))
    out = tmp_path / "deep" / "out"
    with pytest.raises(ColmapVgError):
        main(tmp_path, out)
    assert list((tmp_path / "deep").iterdir()) == []
    with pytest.raises(ImageFolderError, match="no photographs are there"):
        main(tmp_path / "deep", out)


def test_smaller_images_are_as_stored_before_any_exif_orientation(tmp_path: Path) -> None:
    """As COLMAP and nerfstudio read the images, so that the calibration fits all sizes."""
    (tmp_path / "images").mkdir()
    write_jpeg(tmp_path / "images" / "a.jpg", np.zeros((60, 80, 3), np.uint8), orientation=6)
    first = min((tmp_path / "images").iterdir())
    stored = cv2.imread(str(first), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION).shape
    assert cv2.imread(str(first)).shape[:2] == stored[1::-1]
    nerfstudio_mapper._downscale(tmp_path / "images", 1)
    small = cv2.imread(str(tmp_path / "images_2" / first.name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert small.shape[:2] == (stored[0] // 2, stored[1] // 2)
