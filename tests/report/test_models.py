"""What the report shows of a model."""

from pathlib import Path

import numpy as np
import pycolmap
from report_outputs import large_job

from colmap_vg.report.models import ModelView, model_view, read_model


def view_of(tmp_path: Path, max_points: int) -> tuple[pycolmap.Reconstruction, ModelView]:
    output = large_job(tmp_path / "out", num_images=20, num_points=1000)
    model = read_model(output / "0")
    rows = {f"street {row:04d}.jpg": row for row in range(20)}
    return model, model_view("0", model, rows, max_points)


def test_images_and_points(tmp_path: Path) -> None:
    model, view = view_of(tmp_path, 300)
    assert view.images.tolist() == list(range(20))
    assert view.num_points == 1000
    assert len(view.points) == len(view.colors) == 300
    assert view.error_counts.sum() == 1000
    assert view.track_counts[3] == 1000
    true = np.array([image.projection_center() for _, image in sorted(model.images.items())])
    distances = [np.linalg.norm(c[:, None] - c[None], axis=2) for c in (true, view.centers)]
    np.testing.assert_allclose(*distances, atol=1e-9)


def test_the_third_axis_points_up_and_frusta_open_forwards(tmp_path: Path) -> None:
    _, view = view_of(tmp_path, 1000)
    # The cameras' y axes, which point down, are the world's; the upper corners come first.
    np.testing.assert_allclose(np.ptp(view.centers[:, 2]), 0.0, atol=1e-9)
    assert (view.corners[:, :2, 2] > view.corners[:, 2:, 2]).all()
    middle = view.corners.mean(axis=1) - view.centers
    assert (middle @ (np.median(view.points, axis=0) - view.centers.mean(axis=0)) > 0).all()


def test_points_far_away_do_not_shrink_the_view(tmp_path: Path) -> None:
    output = large_job(tmp_path / "out", num_images=20, num_points=1000)
    model = read_model(output / "0")
    first = model.point3D(min(model.points3D))
    first.xyz = [1e6, 0.0, 0.0]
    view = model_view("0", model, {f"street {row:04d}.jpg": row for row in range(20)}, 1000)
    assert view.num_far >= 1
    assert np.ptp(view.points, axis=0).max() < 100.0


def test_an_empty_model(tmp_path: Path) -> None:
    view = model_view("0", pycolmap.Reconstruction(), {}, 10)
    assert view.num_points == 0
    assert view.centers.shape == (0, 3)
    assert np.isfinite(view.low).all()
