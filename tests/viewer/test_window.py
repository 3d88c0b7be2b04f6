"""The window of Open3D: its geometries, and a clear error where no window can be opened."""

import sys

import numpy as np
import pytest
from synthetic_databases import make_database

from colmap_vg import MappingOptions
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.errors import ViewerError
from colmap_vg.viewer.drawing import drawing
from colmap_vg.viewer.finished_job import read_finished_job
from colmap_vg.viewer.session import Session
from colmap_vg.viewer.window import frusta, geometries, show_window


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("window")
    make_database(folder / "database.db", num_images=6, num_points=200)
    mapper(folder / "database.db", None, folder / "out", MappingOptions(), False, Reporter(quiet=True), False)
    return Session(read_finished_job(folder / "out"))


def test_frusta_are_what_cameras_see(session: Session) -> None:
    drawn = drawing(session, session.after)
    points, lines, colors = frusta(drawn)
    assert (points.shape, lines.shape, colors.shape) == ((30, 3), (48, 2), (48, 3))
    np.testing.assert_allclose(points[::5], drawn.centers)
    # Corners project to the corners of the image.
    corners = points.reshape(6, 5, 3)[:, 1:] - drawn.centers[:, None]
    local = np.einsum("kba,kcb->kca", drawn.rotations, corners)
    size = session.job.sizes[drawn.images][:, None]
    focal = session.job.graph.camera_focal_lengths[0] * session.after.focal_scales[0]
    np.testing.assert_allclose(np.abs(focal * local[:, :, :2] / local[:, :, 2:]), np.tile(size / 2, (1, 4, 1)))
    assert {tuple(np.sort(line % 5)) for line in lines} == {(0, k) for k in range(1, 5)} | {
        (1, 2), (2, 3), (3, 4), (1, 4)
    }  # fmt: skip


def test_geometries_hold_cameras_pairs_and_points(session: Session) -> None:
    cameras, pairs, cloud = geometries(session)
    assert len(cameras.lines) == 6 * 8
    assert len(pairs.lines) == session.job.graph.num_edges
    assert len(cloud.points) == len(session.job.points)
    np.testing.assert_allclose(np.asarray(cloud.colors), session.job.colors / 255.0)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_without_a_display_the_error_says_what_to_do(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewerError, match="use --backend viser"):
        show_window(session)
