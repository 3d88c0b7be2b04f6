"""Commands and Python snippets of README, CONTRIBUTING and docs run, or are parsed as their programs would."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from rig_scenes import render_rig
from synthetic_databases import changed_copy, make_database
from typer.main import get_command

from colmap_vg.cli import colmap_flags
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.main import app
from colmap_vg.cli.reporter import Reporter
from colmap_vg.demo import render_photographs
from colmap_vg.options import MappingOptions
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict, SolutionStatus

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
VERBS: dict[str, Any] = get_command(app).commands  # type: ignore[attr-defined]

NOT_RUN = {
    "python3": "makes virtual environments",
    "pip": "installs packages from a network",
    "pytest": "is this test's own program",
    "ruff": "a linter, which CI runs",
    "mypy": "a linter, which CI runs",
    "lint-imports": "a linter, which CI runs",
    "sphinx-build": "builds the documentation, which CI does",
    ".": "activates a virtual environment",
}
"""Programs whose commands are neither run nor parsed, and why."""

NEED_PHOTOGRAPHS = ("run", "demo")
"""Verbs whose commands run on rendered photographs. Scripts of pipelines/ are only parsed: they need data."""

OTHER_PROGRAMS_FLAGS = {
    "pytest": ("--benchmark-only", "--run-slow"),
    "ruff": ("--check",),
    "sphinx-build": ("--keep-going",),
    "ns-process-data": ("--colmap-cmd", "--sfm-tool", "--matching-method", "--output-dir", "--data"),
    "pip": ("--no-deps", "--force-reinstall"),
    "colmap feature_extractor and matchers": (
        "--ImageReader.camera_model",
        "--ImageReader.camera_params",
        "--ImageReader.single_camera",
        "--ImageReader.single_camera_per_folder",
        "--ImageReader.single_camera_per_image",
        "--ImageReader.mask_path",
        "--SiftExtraction.max_num_features",
        "--SiftExtraction.max_image_size",
        "--FeatureExtraction.max_image_size",
        "--SequentialMatching.overlap",
    ),
}
"""Flags of other programs that pages mention."""


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands() -> list[tuple[str, list[str]]]:
    """Page and words of each command in the shell blocks."""
    found = []
    for page in PAGES:
        for line in "".join(blocks(page, "bash")).splitlines():
            words = shlex.split(line, comments=True)
            while words:
                end = words.index("&&") if "&&" in words else len(words)
                command, words = words[:end], words[end + 1 :]
                while "=" in command[0]:  # variables of the environment
                    command = command[1:]
                found.append((page.name, [command[0].rpartition("/bin/")[2], *command[1:]]))
    return found


OURS = [(page, words[1:]) for page, words in commands() if words[0] == "colmap-vg"]
WITH_PHOTOGRAPHS = sorted({tuple(words) for _, words in OURS if words[0] in NEED_PHOTOGRAPHS})
SCRIPTS = [(page, words[1:]) for page, words in commands() if words[0] == "python"]
SNIPPETS = [(f"{page.name}-{k}", text) for page in PAGES for k, text in enumerate(blocks(page, "python"))]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what snippets name: photographs, a database, and the finished jobs ``demo`` and ``out``."""
    folder = tmp_path_factory.mktemp("snippets")
    make_database(folder / "original.db", num_images=6, num_points=120, noise_px=0.5)
    names = [f"{row:04d}.jpg" for row in range(6)]
    renamed = [("UPDATE images SET name = ? WHERE image_id = ?", (name, row + 1)) for row, name in enumerate(names)]
    database = changed_copy(folder / "original.db", folder / "database.db", *renamed)
    (folder / "photos").mkdir()
    _, encoded = cv2.imencode(".jpg", np.full((768, 1024, 3), (40, 90, 200), np.uint8))
    for name in names:
        (folder / "photos" / name).write_bytes(encoded.tobytes())
    mapper(database, folder / "photos", folder / "demo", MappingOptions(), False, Reporter(quiet=True), False)
    shutil.copyfile(database, folder / "demo" / "database.db")
    shutil.copytree(folder / "photos", folder / "demo" / "images")
    shutil.copytree(folder / "demo", folder / "out")
    return folder


@pytest.fixture
def workplace(finished: Path, tmp_path: Path) -> Path:
    """A copy of that folder, which a snippet may change."""
    return Path(shutil.copytree(finished, tmp_path / "work"))


def run_in(folder: Path, *words: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    finished = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def parse(words: list[str]) -> None:
    """Parse the words behind ``colmap-vg`` as the command line does."""
    context = VERBS[words[0]].make_context(words[0], list(words[1:]))
    colmap_flags.ignored_flags(context.args)


@cache
def help_of(*words: str) -> str:
    return run_in(ROOT, *words, "--help")


def test_every_command_is_of_a_known_program() -> None:
    unknown = {words[0] for _, words in commands()} - {"colmap-vg", "python", *NOT_RUN}
    assert not unknown
    assert len(OURS) >= 8


def test_no_block_is_without_a_language() -> None:
    for page in PAGES:
        fences = re.findall(r"^```(.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        opening = fences[::2]
        if page.name == "output.md":
            opening.remove("")  # its list of files
        assert "" not in opening, page


@pytest.mark.parametrize(("page", "words"), OURS, ids=lambda value: value if isinstance(value, str) else value[0])
def test_commands_parse(page: str, words: list[str]) -> None:
    parse(words)


@pytest.mark.parametrize("words", [["run", "--image_pth", "x"], ["solve", "--database_path", "d", "--method", "3C"]])
def test_wrong_commands_do_not_parse(words: list[str]) -> None:
    with pytest.raises(Exception, match=r"image_pth|3C|[Mm]issing"):
        parse(words)


@pytest.mark.parametrize(
    ("page", "words"),
    [(page, words) for page, words in OURS if words[0] not in NEED_PHOTOGRAPHS],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_commands_run(page: str, words: list[str], workplace: Path) -> None:
    output = run_in(workplace, "-m", "colmap_vg", *words)
    assert output or words[0] != "explain"


@pytest.mark.slow
@pytest.mark.parametrize("words", WITH_PHOTOGRAPHS, ids=" ".join)
def test_commands_on_photographs_run(words: tuple[str, ...], tmp_path: Path) -> None:
    if "--rigs" in words:
        render_rig(tmp_path / "photos", num_frames=4)
    elif words[0] != "demo":
        (tmp_path / "photos").mkdir()
        render_photographs(tmp_path / "photos", num_images=6)
    output = run_in(tmp_path, "-m", "colmap_vg", *words)
    folder = tmp_path / words[words.index("--output_path") + 1]
    assert f"report: {folder.name}/report.html\n" in output
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["images"]["left_out"] == {}
    assert pycolmap.Reconstruction(folder / "0").num_reg_images() == summary["images"]["num_images"]


@pytest.mark.parametrize(("page", "words"), SCRIPTS, ids=lambda value: value if isinstance(value, str) else value[0])
def test_scripts_have_the_flags(page: str, words: list[str]) -> None:
    told = help_of(words[0])
    for word in words[1:]:
        assert not word.startswith("--") or re.search(rf"{word}\b", told), word


@pytest.mark.parametrize(("name", "text"), SNIPPETS, ids=[name for name, _ in SNIPPETS])
def test_python_snippets_run(name: str, text: str, workplace: Path) -> None:
    output = run_in(workplace, "-W", "error", "-c", text)
    assert output or "print" not in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_flags_in_the_text_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    mentioned = set(re.findall(r"(?<![\w-])--[A-Za-z](?:[\w.-]*\w)?", text))
    known = {name for verb in VERBS.values() for option in verb.params for name in option.opts}
    known |= {*colmap_flags.OBEYED, *colmap_flags.IGNORED, *colmap_flags.REFUSED}
    known |= {flag for flags in OTHER_PROGRAMS_FLAGS.values() for flag in flags}
    for words in set(re.findall(r"(pipelines/\w+\.py)(?: ([a-z]+)\b)?", text)):
        known |= set(re.findall(r"--\w+", help_of(*filter(None, words))))
    assert mentioned <= known


def test_all_flags_of_other_mappers_that_matter_are_in_the_table() -> None:
    page = (ROOT / "docs" / "from_colmap.md").read_text(encoding="utf-8")
    assert [flag for flag in (*colmap_flags.OBEYED, *colmap_flags.REFUSED) if f"`{flag}`" not in page] == []


@pytest.mark.parametrize("name", ["output.md", "when_it_fails.md"])
def test_all_verdicts_are_explained(name: str) -> None:
    page = (ROOT / "docs" / name).read_text(encoding="utf-8")
    for verdict in (*EdgeVerdict, *ImageVerdict, *SolutionStatus):
        assert f"`{verdict}`" in page, verdict


def test_links_lead_to_files() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_pictures_have_text() -> None:
    for page in PAGES:
        for text in re.findall(r"!\[([^\]]*)\]", page.read_text(encoding="utf-8")):
            assert text.strip(), page
