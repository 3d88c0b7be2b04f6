"""The database of an image folder is whole or absent, and is reused only for the same photographs and options."""

from dataclasses import replace
from pathlib import Path

import pytest
from rendered_corner import render_corner

from colmap_vg.errors import ImageFolderError, OutputError
from colmap_vg.events import StageLog
from colmap_vg.jobs.image_folder import make_database
from colmap_vg.options import FeatureOptions

OPTIONS = FeatureOptions(num_threads=2, max_num_features=300, max_image_size=200)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corner") / "images"
    render_corner(4).write(folder)
    return folder


def stages(log: StageLog) -> list[str]:
    return [record.stage for record in log.records]


def test_finished_database_is_reused_on_resume_only(tmp_path: Path, images: Path) -> None:
    first = make_database(images, tmp_path, OPTIONS)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".work", "database.db"]
    before = (tmp_path / "database.db").read_bytes()
    log = StageLog()
    assert make_database(images, tmp_path, OPTIONS, log, resume=True) == first
    assert stages(log) == ["photographs"]
    assert (tmp_path / "database.db").read_bytes() == before
    log = StageLog()
    assert make_database(images, tmp_path, OPTIONS, log) == first
    assert stages(log) == ["photographs", "features", "matching"]


def test_unfinished_database_is_gone_on_with(tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("colmap_vg.jobs.image_folder.match_features_apart", interrupt)
        with pytest.raises(KeyboardInterrupt):
            make_database(images, tmp_path, OPTIONS)
    assert not (tmp_path / "database.db").exists()
    unfinished = (tmp_path / ".work" / "database.db").stat().st_ino
    make_database(images, tmp_path, OPTIONS, resume=True)
    assert (tmp_path / "database.db").stat().st_ino == unfinished


def test_other_options_or_photographs_start_afresh(tmp_path: Path, images: Path) -> None:
    make_database(images, tmp_path, OPTIONS)
    log = StageLog()
    make_database(images, tmp_path, replace(OPTIONS, num_threads=1), log, resume=True)
    assert stages(log) == ["photographs"], "the number of threads changes nothing"
    log = StageLog()
    make_database(images, tmp_path, replace(OPTIONS, max_num_features=200), log, resume=True)
    assert stages(log) == ["photographs", "features", "matching"]
    assert "extracted again" in log.warnings[0]
    (tmp_path / "list.txt").write_text("00.jpg\n01.jpg\n02.jpg\n")
    fewer = replace(OPTIONS, max_num_features=200, image_list_path=tmp_path / "list.txt")
    assert len(make_database(images, tmp_path, fewer, resume=True).image_names) == 3


def test_a_database_of_the_users_own_is_not_replaced(tmp_path: Path, images: Path) -> None:
    (tmp_path / "database.db").write_text("precious")
    with pytest.raises(OutputError, match="overwrite=True"):
        make_database(images, tmp_path, OPTIONS)
    assert (tmp_path / "database.db").read_text() == "precious"
    assert make_database(images, tmp_path, OPTIONS, overwrite=True).num_verified_pairs > 0


def test_bad_photographs_leave_a_finished_database_alone(tmp_path: Path, images: Path) -> None:
    make_database(images, tmp_path, OPTIONS)
    before = (tmp_path / "database.db").read_bytes()
    with pytest.raises(ImageFolderError):
        make_database(tmp_path / "gone", tmp_path, OPTIONS)
    assert (tmp_path / "database.db").read_bytes() == before
