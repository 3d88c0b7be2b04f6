"""COLMAP's command line with our mappers: called as scripts call it."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pycolmap
import pytest
from synthetic_databases import make_database

import colmap_vg.cli.shim as shim
from colmap_vg.cli import colmap_flags

ROOT = Path(__file__).parents[2]
FAKE = '#!/bin/sh\necho "$0 $#"\nfor word in "$@"; do echo "[$word]"; done\nexit 7\n'


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "database.db"
    make_database(path, num_images=4, num_points=80, noise_px=0.5)
    return path


@pytest.fixture
def program(tmp_path: Path) -> Path:
    """The program as pip installs it."""
    return executable(tmp_path / "venv" / "colmap-vg-colmap", console_script())


def console_script() -> str:
    return f"#!{sys.executable}\nimport sys\nfrom colmap_vg.cli.shim import main\nsys.exit(main())\n"


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


def call(program: Path | str, *arguments: object, on_path: tuple[Path, ...] = ()) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([*map(str, on_path), "/usr/bin", "/bin"])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [str(program), *map(str, arguments)], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def test_the_program_is_installed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"][shim.NAME] == "colmap_vg.cli.shim:main"


@pytest.mark.parametrize(
    "command",
    [
        ["mapper", "--Mapper.ba_global_function_tolerance=1e-6", "--Mapper.num_threads", "1"],
        ["global_mapper", "--GlobalMapper.num_threads", "1", "--GlobalMapper.gp_use_gpu", "0"],
        ["hierarchical_mapper", "--num_workers", "2", "--Mapper.num_threads", "1"],
    ],
    ids=lambda command: command[0],
)
def test_mappers_are_ours(command: list[str], database_path: Path, program: Path, tmp_path: Path) -> None:
    (tmp_path / "sparse").mkdir()  # as scripts do
    paths = ("--database_path", database_path, "--image_path", tmp_path, "--output_path", tmp_path / "sparse")
    fake = executable(tmp_path / "bin" / "colmap", FAKE)
    told = call(program, command[0], *paths, *command[1:], "--report", "0", on_path=(fake.parent,))
    assert told.returncode == 0, told.stderr
    assert pycolmap.Reconstruction(tmp_path / "sparse" / "0").num_reg_images() == 4
    ignored = [word.partition("=")[0] for word in command if word.partition("=")[0] in colmap_flags.IGNORED]
    assert all(f"{flag} has no counterpart" in told.stdout for flag in ignored)
    assert len(ignored) >= 1


def test_errors_have_our_exit_codes(program: Path, tmp_path: Path) -> None:
    missing = call(program, "mapper", "--database_path", tmp_path / "none", "--output_path", tmp_path / "out")
    assert missing.returncode == 1
    assert missing.stderr.startswith("error: ")
    assert call(program, "mapper", "--database_pth", "x").returncode == 2
    single = call(program, "global_mapper", "-database_path", "x")
    assert single.returncode == 2
    assert "did you mean --database_path" in single.stderr


@pytest.mark.parametrize("words", [["feature_extractor", "--image_path", "a b", "--x=*"], ["help"], []])
def test_other_commands_go_to_colmap(words: list[str], program: Path, tmp_path: Path) -> None:
    fake = executable(tmp_path / "bin" / "colmap", FAKE)
    told = call(program, *words, on_path=(fake.parent,))
    assert told.returncode == 7
    assert told.stdout.splitlines() == [f"{fake} {len(words)}", *(f"[{word}]" for word in words)]


def test_without_colmap_the_error_says_what_does_it(program: Path) -> None:
    told = call(program, "image_undistorter", "--image_path", "x")
    assert told.returncode == 1
    assert told.stderr == (
        "error: image_undistorter is a command of colmap, and there is no colmap on PATH: install COLMAP, or use"
        " pycolmap.undistort_images\n"
    )
    assert call(program, "no_such_command").stderr.endswith("on PATH: install COLMAP\n")
    assert "hierarchical_mapper" in call(program, "--help").stdout


def test_what_is_named_instead_exists() -> None:
    named = [
        word.strip(",") for text in shim._INSTEAD.values() for word in text.split() if word.startswith("pycolmap.")
    ]
    assert len(named) > 8
    for name in named:
        assert hasattr(pycolmap, name.removeprefix("pycolmap.")), name
    assert all(
        hasattr(pycolmap.Reconstruction, name) for name in ("write_text", "write_binary", "export_PLY", "summary")
    )


@pytest.mark.parametrize("name", ["colmap", "glomap"])
def test_a_link_under_the_real_name_finds_the_real_program(name: str, program: Path, tmp_path: Path) -> None:
    (tmp_path / "links").mkdir()
    link = tmp_path / "links" / name
    link.symlink_to(program)
    real = executable(tmp_path / "bin" / name, FAKE)
    told = call(link, "version", on_path=(link.parent, real.parent))
    assert told.stdout.splitlines() == [f"{real} 1", "[version]"]


def test_a_wrapper_under_the_real_name_does_not_call_itself_forever(program: Path, tmp_path: Path) -> None:
    wrapper = executable(tmp_path / "wrappers" / "colmap", f'#!/bin/sh\nexec "{program}" "$@"\n')
    told = call(wrapper, "version", on_path=(wrapper.parent,))
    assert told.returncode == 1
    assert "no colmap on PATH" in told.stderr
    real = executable(tmp_path / "bin" / "colmap", FAKE)
    told = call(wrapper, "version", on_path=(wrapper.parent, real.parent))
    assert told.stdout.splitlines()[0] == f"{real} 1"


def test_a_program_that_cannot_run_is_one_line(program: Path, tmp_path: Path) -> None:
    broken = executable(tmp_path / "bin" / "colmap", "#!/no/such/interpreter\n")
    told = call(program, "feature_extractor", on_path=(broken.parent,))
    assert told.returncode == 1
    assert told.stderr.startswith(f"error: cannot run {broken}: ")
    assert len(told.stderr.splitlines()) == 1
