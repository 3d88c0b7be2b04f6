"""The rendered photographs show what the cameras they claim would see; the demo ends with the truth."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from colmap_vg.cli.main import app
from colmap_vg.demo.photographs import camera_ring, render_photographs, true_camera, write_truth
from colmap_vg.demo.render import RayCaster, pixel_rays
from colmap_vg.demo.scene import _arch, _columns, _rubble, _walls, build_ruin
from colmap_vg.demo.texture import paint


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    rng = np.random.default_rng(3)
    return RayCaster(paint(build_ruin(rng), rng, texels_per_metre=60.0))


def test_faces_are_planar_and_the_ground_looks_up() -> None:
    scene = build_ruin(np.random.default_rng(0))
    normals = scene.normals()
    heights = np.einsum("qa,qka->qk", normals, scene.quads - scene.quads[:, :1])
    assert np.abs(heights).max() < 1e-9
    assert normals[0] @ [0, 0, 1] == pytest.approx(1.0)  # the ground


@pytest.mark.parametrize("part", [_walls, _columns, _arch, _rubble])
def test_faces_of_solids_look_away_from_their_middle(part: Callable[..., list[tuple[np.ndarray, int]]]) -> None:
    for quads, _ in part(np.random.default_rng(0)):
        normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
        outwards = quads.mean(axis=1) - quads.mean(axis=(0, 1))
        assert (np.einsum("qa,qa->q", normals, outwards) > 0).all()


def test_faces_have_texture_of_their_own() -> None:
    rng = np.random.default_rng(1)
    textured = paint(build_ruin(rng), rng, texels_per_metre=60.0)
    height, width, _ = textured.texture.shape
    taken = np.zeros((height, width), dtype=int)
    for quad, origin, axes in zip(textured.scene.quads, textured.origins, textured.axes, strict=True):
        texels = origin + (quad - quad[0]) @ axes.T
        low, high = np.floor(texels.min(axis=0)).astype(int), np.ceil(texels.max(axis=0)).astype(int)
        assert (low >= 0).all()
        assert high[0] <= width
        assert high[1] <= height
        taken[low[1] : high[1], low[0] : high[0]] += 1
    assert taken.max() == 1


def test_pixels_see_the_points_that_project_into_them(caster: RayCaster) -> None:
    camera = true_camera()
    rotations, centers = camera_ring(8, np.random.default_rng(5))
    R, center = rotations[2], centers[2]
    rays = pixel_rays(camera, 1) @ R
    quad, depth = caster.hits(center, rays)
    rows, columns = (k[::997] for k in np.nonzero(quad >= 0))
    points = center + depth[rows, columns, None] * rays[rows, columns]
    projected = camera.img_from_cam((points - center) @ R.T)
    np.testing.assert_allclose(projected, np.stack([columns + 0.5, rows + 0.5], axis=1), atol=0.05)
    # The points lie on the planes of the faces that were hit.
    scene = caster._textured.scene
    corner, normal = scene.quads[quad[rows, columns], 0], scene.normals()[quad[rows, columns]]
    assert np.abs(np.einsum("ka,ka->k", points - corner, normal)).max() < 1e-4


@pytest.mark.slow
def test_photographs_are_the_seeds_and_tell_colmap_their_focal_length(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("a", "b", "c")]
    for folder, seed in zip(folders, (4, 4, 5), strict=True):
        folder.mkdir()
        cameras = render_photographs(folder, num_images=1, seed=seed)
    first, again, other = ((folder / "0000.jpg").read_bytes() for folder in folders)
    assert first == again
    assert first != other
    assert cv2.imread(str(folders[0] / "0000.jpg")).shape == (600, 800, 3)
    guess = pycolmap.infer_camera_from_image(folders[0] / "0000.jpg")
    assert guess.has_prior_focal_length
    assert guess.mean_focal_length() == pytest.approx(cameras.camera.mean_focal_length(), rel=0.01)


@pytest.mark.slow
def test_threads_do_not_change_photographs(tmp_path: Path) -> None:
    for threads in (1, 3):
        (tmp_path / str(threads)).mkdir()
        render_photographs(tmp_path / str(threads), num_images=4, num_threads=threads)
    for one in sorted((tmp_path / "1").iterdir()):
        assert one.read_bytes() == (tmp_path / "3" / one.name).read_bytes()


def test_truth_is_written_as_poses(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    cameras = render_photographs(tmp_path / "images", num_images=2, seed=0)
    write_truth(tmp_path / "truth.txt", cameras)
    rows = [line.split() for line in (tmp_path / "truth.txt").read_text().splitlines() if not line.startswith("#")]
    assert [row[0] for row in rows] == list(cameras.names)
    values = np.array([row[1:] for row in rows], dtype=float)
    R = np.array([pycolmap.Rotation3d(q).matrix() for q in values[:, :4]])
    np.testing.assert_allclose(R, cameras.rotations, atol=1e-8)
    np.testing.assert_allclose(-np.einsum("kba,kb->ka", R, values[:, 4:7]), cameras.centers, atol=1e-7)
    np.testing.assert_allclose(values[:, 7:], cameras.centers, atol=1e-8)


def test_too_few_images_are_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "--output_path", str(tmp_path / "out"), "--num_images", "2"])
    assert result.exit_code == 2
    assert "num_images" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_demo_ends_within_three_thousandths_of_the_radius(tmp_path: Path) -> None:
    arguments = ["demo", "--output_path", str(tmp_path / "out"), "--num_images", "8", "--quiet"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["comparison"]["num_registered"] == 8
    assert not any("look" in warning and "alike" in warning for warning in summary["warnings"])
    assert summary["comparison"]["mean_position_error_share"] <= 0.003
    assert pycolmap.Reconstruction(tmp_path / "out" / "0").num_reg_images() == 8
