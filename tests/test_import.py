"""What is imported when: the numerics without COLMAP, the command line's help without anything heavy."""

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import colmap_vg

ABOVE_THE_NUMERICS = (
    "cli",
    "report",
    "exports",
    "viewer",
    "demo",
    "jobs",
    "reading",
    "features",
    "mapping",
    "colmap_io",
    "simulation",
)


def run_python(code: str) -> str:
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout.strip()


def loaded_after(imports: list[str], suspects: list[str]) -> str:
    statements = "".join(f"import {name}\n" for name in imports)
    return run_python(f"{statements}import sys\nprint([name for name in {suspects!r} if name in sys.modules])")


def test_package_imports_without_anything_heavy() -> None:
    assert loaded_after(["colmap_vg"], ["numpy", "scipy", "pycolmap", "open3d", "cv2"]) == "[]"


def test_numerics_import_without_colmap() -> None:
    modules = [module.name for module in pkgutil.walk_packages(colmap_vg.__path__, "colmap_vg.")]
    numerics = [name for name in modules if name.split(".")[1] not in (*ABOVE_THE_NUMERICS, "__main__")]
    assert "colmap_vg.scene.view_graph" in numerics
    assert loaded_after(numerics, ["pycolmap", "open3d", "cv2"]) == "[]"


def test_command_line_starts_without_anything_heavy() -> None:
    assert (
        loaded_after(["colmap_vg.cli.main"], ["numpy", "scipy", "pycolmap", "open3d", "cv2", "rich.progress"]) == "[]"
    )


def test_zlib_works_after_pycolmap() -> None:
    # Without libz loaded first, pycolmap 4.2's bundled copy makes zlib.compress abort: free(): invalid pointer.
    code = "import colmap_vg, pycolmap, zlib\nprint(len(zlib.decompress(zlib.compress(bytes(100_000)))))"
    assert run_python(code) == "100000"


def test_zlib_is_the_first_import_of_the_package() -> None:
    source = ast.parse(Path(colmap_vg.__file__).read_text(encoding="utf-8"))
    first = next(node for node in source.body if isinstance(node, ast.Import | ast.ImportFrom))
    assert isinstance(first, ast.Import)
    assert first.names[0].name == "zlib"


def test_every_public_name_is_there() -> None:
    assert sorted(colmap_vg.__all__) == list(colmap_vg.__all__), "kept in order"
    for name in colmap_vg.__all__:
        assert getattr(colmap_vg, name) is not None
    assert set(dir(colmap_vg)) == set(colmap_vg.__all__)
