"""A process of feature extraction or matching that is killed is one error that names memory; the job can be resumed."""

import subprocess
from pathlib import Path
from typing import Any

import pytest
from rendered_corner import render_corner

from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.jobs.image_folder import make_database
from colmap_vg.options import FeatureOptions

OPTIONS = FeatureOptions(num_threads=1, max_num_features=300, max_image_size=240, matching="sequential")


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corner") / "images"
    render_corner(4).write(folder)
    return folder


@pytest.mark.parametrize(("stage", "said"), [("features", "0 of 4 photographs"), ("matching", "0 of 6 pairs")])
def test_a_killed_process_is_an_error_that_names_memory_and_leaves_a_job_to_resume(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, stage: str, said: str
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def remembered(*arguments: Any, **options: Any) -> "subprocess.Popen[bytes]":
        started.append(start(*arguments, **options))
        return started[-1]

    def kill(event: StageEvent) -> None:
        if (event.stage, event.state, event.message) == (stage, "progress", said):
            started[-1].kill()

    with monkeypatch.context() as patch:
        patch.setattr("colmap_vg.features.isolated.subprocess.Popen", remembered)
        with pytest.raises(ImageFolderError, match="killed, most likely because memory ran out: lower num_threads"):
            make_database(images, tmp_path, OPTIONS, StageLog(kill))
    assert started[-1].returncode < 0
    assert not (tmp_path / "database.db").exists()
    unfinished = (tmp_path / ".work" / "database.db").stat().st_ino
    log = StageLog()
    assert make_database(images, tmp_path, OPTIONS, log, resume=True).num_verified_pairs > 0
    assert not log.warnings
    assert (tmp_path / "database.db").stat().st_ino == unfinished


def test_a_process_killed_before_it_reads_its_task_is_the_same_error(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = subprocess.Popen

    def killed(*arguments: Any, **options: Any) -> "subprocess.Popen[bytes]":
        process = start(*arguments, **options)
        process.kill()
        process.wait()
        return process

    monkeypatch.setattr("colmap_vg.features.isolated.subprocess.Popen", killed)
    with pytest.raises(ImageFolderError, match="killed, most likely because memory ran out"):
        make_database(images, tmp_path, OPTIONS)
