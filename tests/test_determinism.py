"""The same input, options and seed give the same bits with one thread, and the same model within bounds with more."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rendered_corner import render_corner

from colmap_vg import align_positions
from colmap_vg.report.page import write_report

pytestmark = pytest.mark.slow

OPTIONS = ["--max_num_features", "500", "--max_image_size", "320"]
MAX_POSITION_SHARE, MAX_ANGLE_DEG = 1e-3, 0.05
"""Between runs with several threads: of the scene's radius, and degrees. Sums in another order change bundle adjustment
by rounding, and that a match at the edge of a threshold."""


@pytest.fixture(scope="module")
def images_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corner") / "images"
    render_corner(5).write(folder)
    return folder


def run(images_path: Path, output: Path, num_threads: int) -> Path:
    """In a process of its own, so that nothing before it counts."""
    arguments = ["run", "--image_path", images_path, "--output_path", output, "--num_threads", num_threads, *OPTIONS]
    command = [sys.executable, "-m", "colmap_vg", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return output


def test_one_thread_gives_the_same_bits(images_path: Path, tmp_path: Path) -> None:
    first, second = (run(images_path, tmp_path / name / "out", 1) for name in ("a", "b"))
    files = {path.relative_to(first) for path in first.rglob("*") if path.is_file()}
    assert files == {path.relative_to(second) for path in second.rglob("*") if path.is_file()}
    names = {str(file) for file in files}
    assert {"database.db", "images.csv", "pairs.csv", "summary.json", "0/images.bin", "0/points3D.bin"} <= names
    # The summary and the report tell times, and the job's record the output folder.
    for file in sorted(files - {Path("summary.json"), Path("report.html"), Path(".work/job.json")}):
        assert (first / file).read_bytes() == (second / file).read_bytes(), file
    reported = (first / "report.html").read_bytes()
    assert write_report(first, images_path).read_bytes() == reported
    contents = [json.loads((output / "summary.json").read_text(encoding="utf-8")) for output in (first, second)]
    for content, output in zip(contents, (first, second), strict=True):
        for key in ("seconds", "peak_memory_mib"):
            del content[key]
            for stage in content["stages"]:
                del stage[key]
        text = json.dumps(content).replace(str(output), "OUT")
        content.clear()
        content["text"] = text
    assert contents[0] == contents[1]


def test_several_threads_give_the_same_model_within_bounds(images_path: Path, tmp_path: Path) -> None:
    outputs = [run(images_path, tmp_path / str(k), threads) for k, threads in enumerate((1, 3, 3))]
    models = [pycolmap.Reconstruction(output / "0") for output in outputs]
    poses = [{m.image(i).name: m.image(i).cam_from_world() for i in m.reg_image_ids()} for m in models]
    names = sorted(poses[0])
    centers, rotations = (
        [np.array([take(p[name]) for name in names]) for p in poses if sorted(p) == names]
        for take in (lambda pose: pose.inverse().translation, lambda pose: pose.rotation.matrix())
    )
    assert len(centers) == 3, "the same images are registered"
    for other, turned in zip(centers[1:], rotations[1:], strict=True):
        errors, similarity = align_positions(other, centers[0])
        radius = np.linalg.norm(centers[0] - centers[0].mean(axis=0), axis=1).max()
        assert errors.max() < MAX_POSITION_SHARE * radius
        relative = turned @ similarity.rotation.T @ np.swapaxes(rotations[0], 1, 2)
        cosine = (np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0
        assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < MAX_ANGLE_DEG
