"""The examples are short, and run."""

import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 120
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_PINHOLE, [1280.0, 512.0, 384.0]
    options.camera_has_prior_focal_length = True
    with pycolmap.Database.open(path) as database:
        pycolmap.synthesize_dataset(options, database)
    return path


def run(script: Path, *arguments: object) -> str:
    finished = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def test_examples_are_short() -> None:
    assert len(EXAMPLES) >= 2
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) < 80, path


def test_solving_a_viewing_graph_alone(database_path: Path) -> None:
    output = run(ROOT / "examples" / "solve_view_graph.py", database_path, "2O")
    assert output.startswith("solved")
    assert output.count(": registered") == 8
    assert "28 edges: kept" in output


def test_pose_graph_from_a_file(tmp_path: Path) -> None:
    information = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4e9 0 0 4e9 0 4e9"
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    lines = [f"VERTEX_SE3:QUAT {k} {x} {y} 0 0 0 0 1" for k, (x, y) in enumerate(corners)]
    steps = [(0, 1, "1.1 0 0"), (1, 2, "0 1 0"), (2, 3, "-1 0 0"), (3, 0, "0 -1 0")]
    lines += [f"EDGE_SE3:QUAT {i} {j} {step} 0 0 0 1 {information}" for i, j, step in steps]
    path = tmp_path / "square.g2o"
    path.write_text("\n".join(lines) + "\n")
    for flags in ([], ["--full_information"]):
        output = run(ROOT / "examples" / "pose_graph_g2o.py", path, *flags)
        # A tenth of a metre is spread over four sides of equal certainty; rotations are all but certain.
        assert "4 poses, 4 edges: converged, cost 0.0025," in output


def test_swapping_the_mapper(database_path: Path, tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "swap_global_mapping.py", database_path, tmp_path, tmp_path / "out")
    assert "view_graph_mapping model 0: 8 images" in output
    assert "global_mapping model 0: 8 images" in output


def test_database_pipeline(database_path: Path, tmp_path: Path) -> None:
    assert str(tmp_path / "0") in run(ROOT / "pipelines" / "database.py", database_path, tmp_path)
    assert pycolmap.Reconstruction(tmp_path / "0").num_reg_images() == 8


@pytest.mark.parametrize("script", [*EXAMPLES, *sorted((ROOT / "pipelines").glob("*.py"))], ids=lambda path: path.stem)
def test_wrong_arguments_show_the_usage(script: Path) -> None:
    finished = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=False)
    assert finished.returncode != 0
    assert "sage:" in finished.stderr
    assert "Traceback" not in finished.stderr
