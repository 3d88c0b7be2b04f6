"""Models aligned to known camera positions and to survey points, and what cannot be aligned."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from measured_positions import by_gps, east_north_up
from typer.testing import CliRunner, Result

from colmap_vg.cli.main import app
from colmap_vg.geometry import so3

TURN, SCALE, SHIFT = so3.exp(np.array([[0.4, -1.1, 0.3]]))[0], 12.0, np.array([500.0, -300.0, 80.0])
"""From the model's frame to that of the known positions."""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("align") / "model"
    folder.mkdir()
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=12, num_points3D=60)
    pycolmap.synthesize_dataset(options).write(folder)
    return folder


def known(points: np.ndarray) -> np.ndarray:
    return SCALE * points @ TURN.T + SHIFT


def cameras(folder: Path) -> tuple[list[str], np.ndarray]:
    found = pycolmap.Reconstruction(folder)
    images = [found.image(i) for i in sorted(found.reg_image_ids())]
    return [image.name for image in images], np.array([image.projection_center() for image in images])


def align(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["align", *map(str, arguments)])


def write_rows(path: Path, names: list[str], places: np.ndarray) -> Path:
    path.write_text(
        "# name x y z\n\n"
        + "".join(f"{n} {' '.join(map(repr, p))}\n" for n, p in zip(names, places.tolist(), strict=True))
    )
    return path


@pytest.mark.parametrize("gps", [False, True])
def test_cameras_lie_where_they_are_known_to_be(model: Path, tmp_path: Path, gps: bool) -> None:
    names, centers = cameras(model)
    truth = known(centers)
    places = by_gps(truth) if gps else truth.copy()
    places[3] += 0.01 if gps else 100.0
    rows = write_rows(tmp_path / "positions.txt", [*names, "unknown.jpg"], np.concatenate([places, places[:1]]))
    before = {path.name: path.read_bytes() for path in model.iterdir()}
    done = align(
        "--input_path", model, "--output_path", tmp_path / "out", "--ref_images_path", rows, "--ref_is_gps", gps
    )
    assert done.exit_code == 0, done.output
    assert "1 of 12 is wrong" in done.output
    assert {path.name: path.read_bytes() for path in model.iterdir()} == before
    told = json.loads((tmp_path / "out" / "alignment.json").read_text())["georeference"]
    assert told["outliers"] == [names[3]]
    assert told["frame"] == ("ENU" if gps else "cartesian")
    expected = truth
    if gps:
        expected = np.array([east_north_up(*place, tuple(told["origin"])) for place in by_gps(truth)])
    _, aligned = cameras(tmp_path / "out" / "0")
    np.testing.assert_allclose(aligned, expected, atol=2e-3)


def survey(model: Path, path: Path, num_points: int, noise_px: float = 0.0) -> Path:
    """A file of the model's points as survey points, with their keypoints."""
    found, rng, lines = pycolmap.Reconstruction(model), np.random.default_rng(0), []
    for point_id in sorted(found.points3D)[:num_points]:
        point = found.point3D(point_id)
        x, y, z = known(np.asarray(point.xyz)[None])[0]
        for element in point.track.elements[:4]:
            image = found.image(element.image_id)
            u, v = found.camera(image.camera_id).img_from_cam((image.cam_from_world() * point.xyz)[None])[0]
            u, v = np.array([u, v]) + noise_px * rng.normal(size=2)
            lines.append(
                f"P{point_id} {x!r} {y!r} {z!r} {image.name} {u!r} {v!r}\n".replace("np.float64(", "").replace(")", "")
            )
    path.write_text("".join(lines))
    return path


@pytest.mark.parametrize(("noise", "bound"), [(0.0, 1e-6), (0.5, 0.1)])
def test_survey_points_align_a_model(model: Path, tmp_path: Path, noise: float, bound: float) -> None:
    rows = survey(model, tmp_path / "points.txt", 8, noise)
    done = align("--input_path", model, "--output_path", tmp_path / "out", "--ref_points_path", rows)
    assert done.exit_code == 0, done.output
    _, centers = cameras(model)
    _, aligned = cameras(tmp_path / "out" / "0")
    assert np.linalg.norm(aligned - known(centers), axis=1).max() < bound
    residuals = json.loads((tmp_path / "out" / "alignment.json").read_text())["georeference"]["residuals"]
    assert len(residuals) == 8
    assert np.abs(list(residuals.values())).max() < max(bound, 1e-6)


def test_a_model_is_not_replaced_unless_asked(model: Path, tmp_path: Path) -> None:
    rows = write_rows(tmp_path / "positions.txt", *cameras(model))
    job = ("--input_path", model, "--output_path", tmp_path / "out", "--ref_images_path", rows)
    assert align(*job).exit_code == 0
    assert align(*job).exit_code == 1
    assert align(*job, "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("a.jpg 1 2\n", "line 1: expected NAME X Y Z, found 'a.jpg 1 2'"),
        ("a.jpg 1 2 nan\n", "line 1: expected NAME X Y Z"),
        ("# only\n", "holds no position"),
        ("a.jpg 1 2 3\na.jpg 1 2 3\n", "line 2: a.jpg has a second position"),
        ("a.jpg 1 2 3\nb.jpg 4 5 6\n", "0 of 2 known positions are of images of the model"),
    ],
)
def test_bad_files_are_told(model: Path, tmp_path: Path, content: str, told: str) -> None:
    (tmp_path / "positions.txt").write_text(content)
    done = align(
        "--input_path", model, "--output_path", tmp_path / "o", "--ref_images_path", tmp_path / "positions.txt"
    )
    assert done.exit_code == 1
    assert told in done.stderr
    assert not (tmp_path / "o" / "0").exists()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("P 1 2 3 a.jpg 4\n", "expected POINT X Y Z IMAGE U V"),
        ("P 1 2 3 a.jpg 4 5\nP 1 2 4 b.jpg 4 5\n", "line 2: point P has a second position"),
        ("P 1 2 3 a.jpg 4 5\n", "0 of 1 survey points are shown by two images"),
    ],
)
def test_bad_survey_points_are_told(model: Path, tmp_path: Path, content: str, told: str) -> None:
    (tmp_path / "points.txt").write_text(content)
    done = align("--input_path", model, "--output_path", tmp_path / "o", "--ref_points_path", tmp_path / "points.txt")
    assert done.exit_code == 1
    assert told in done.stderr


def test_one_file_of_positions_is_needed(model: Path, tmp_path: Path) -> None:
    done = align("--input_path", model, "--output_path", tmp_path / "out")
    assert done.exit_code == 2
    assert "--ref_images_path or --ref_points_path" in done.stderr


def test_what_is_no_model_is_told(tmp_path: Path) -> None:
    (tmp_path / "positions.txt").write_text("a.jpg 1 2 3\n")
    done = align(
        "--input_path", tmp_path, "--output_path", tmp_path / "o", "--ref_images_path", tmp_path / "positions.txt"
    )
    assert done.exit_code == 1
    assert "is no COLMAP model that can be read" in done.stderr


def test_random_positions_do_not_align(model: Path, tmp_path: Path) -> None:
    names, _ = cameras(model)
    rows = write_rows(tmp_path / "positions.txt", names, np.random.default_rng(0).normal(size=(len(names), 3)))
    done = align("--input_path", model, "--output_path", tmp_path / "out", "--ref_images_path", rows)
    assert done.exit_code == 1
    assert "do not agree with the model" in done.stderr
