"""Every camera model of COLMAP: as exact as a pinhole camera, calibrated or 10 % off; panoramas."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rig_scenes import errors
from typer.testing import CliRunner

from colmap_vg import MappingOptions, align_positions, read_view_graph, view_graph_mapping
from colmap_vg.cli.main import app
from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length
from colmap_vg.demo.render import SAMPLES, RayCaster, photograph
from colmap_vg.demo.scene import build_ruin
from colmap_vg.demo.texture import paint
from colmap_vg.simulation.ring_scenes import look_at

ONE_THREAD = MappingOptions(num_threads=1, extract_colors=False)
MIDDLE = (512.0, 384.0)
NARROW, WIDE = (1280.0, *MIDDLE), (640.0, *MIDDLE)
LENSES: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": NARROW,
    "PINHOLE": (1280.0, *NARROW),
    "SIMPLE_RADIAL": (*NARROW, 0.05),
    "RADIAL": (*NARROW, 0.05, 0.02),
    "OPENCV": (1280.0, *NARROW, 0.05, 0.01, 0.001, 0.001),
    "FULL_OPENCV": (1280.0, *NARROW, 0.05, 0.01, 0.001, 0.001, 0.01, 0.01, 0.01, 0.01),
    "SIMPLE_DIVISION": (*NARROW, -0.05),
    "DIVISION": (1280.0, *NARROW, -0.05),
    "SIMPLE_FISHEYE": WIDE,
    "FISHEYE": (640.0, *WIDE),
    "SIMPLE_RADIAL_FISHEYE": (*WIDE, 0.02),
    "RADIAL_FISHEYE": (*WIDE, 0.02, 0.005),
    "OPENCV_FISHEYE": (640.0, *WIDE, 0.02, 0.005, 0.001, 0.0005),
    "FOV": (640.0, *WIDE, 0.9),
    "THIN_PRISM_FISHEYE": (640.0, *WIDE, 0.02, 0.005, *[0.001] * 6),
    "RAD_TAN_THIN_PRISM_FISHEYE": (640.0, *WIDE, 0.02, 0.005, 0.001, *[0.0005] * 9),
    "EUCM": (640.0, *WIDE, 0.6, 1.1),
    "EQUIRECTANGULAR": (2048.0, 1024.0),
}


def scene(path: Path, model: str, params: tuple[float, ...], share: float = 1.0) -> pycolmap.Reconstruction:
    """Twelve images around points by one camera, whose focal length in the database is a multiple of the true one."""
    pycolmap.set_random_seed(0)
    width, height = (2048, 1024) if model == "EQUIRECTANGULAR" else (1024, 768)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=12,
        num_points3D=150,
        camera_width=width,
        camera_height=height,
        camera_model_id=getattr(pycolmap.CameraModelId, model),
        camera_params=list(params),
        camera_has_prior_focal_length=share == 1.0,
    )
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5)
        pycolmap.synthesize_noise(noise, pycolmap.Reconstruction(truth), database)
        for camera in database.read_all_cameras():
            params = np.array(camera.params)
            params[list(camera.focal_length_idxs())] *= share
            camera.params, camera.has_prior_focal_length = params, share == 1.0
            database.update_camera(camera)
    return truth


def error_of(folder: Path, model: str, params: tuple[float, ...], share: float = 1.0) -> float:
    truth = scene(folder / f"{model}.db", model, params, share)
    models = view_graph_mapping(folder / f"{model}.db", None, folder / model, ONE_THREAD)
    assert models[0].num_reg_images() == 12
    return errors(models[0], truth)[0]


@pytest.fixture(scope="module")
def pinhole_errors(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[float, int], float]:
    """Error of a pinhole camera by its focal length and the number of its focal lengths."""
    folder = tmp_path_factory.mktemp("pinhole")
    found = {}
    for focal in (1280.0, 640.0, 2048.0 / (2 * np.pi)):
        (folder / str(focal)).mkdir()
        found[focal, 1] = error_of(folder / str(focal), "SIMPLE_PINHOLE", (focal, *MIDDLE))
        found[focal, 2] = error_of(folder / str(focal), "PINHOLE", (focal, focal, *MIDDLE))
    return found


def test_no_model_is_forgotten() -> None:
    assert set(LENSES) == set(pycolmap.CameraModelId.__members__) - {"INVALID"}


@pytest.mark.parametrize("share", [1.0, 1.1])
@pytest.mark.parametrize("model", sorted(set(LENSES) - {"SIMPLE_PINHOLE", "PINHOLE"}))
def test_it_is_as_exact_as_a_pinhole_camera(
    tmp_path: Path, model: str, share: float, pinhole_errors: dict[tuple[float, int], float]
) -> None:
    camera = pycolmap.Camera(model=model, width=1024, height=768, params=LENSES[model])
    focal = 2048.0 / (2 * np.pi) if camera.is_spherical() else camera.mean_focal_length()
    if camera.is_spherical() and share != 1.0:
        pytest.skip("a sphere has no focal length")
    bound = 1.1 * pinhole_errors[focal, max(len(camera.focal_length_idxs()), 1)]
    assert error_of(tmp_path, model, LENSES[model], share) <= bound


def test_rays_of_a_sphere_point_in_all_directions() -> None:
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=2048, height=1024, params=(2048, 1024))
    places = np.array([[1024.0, 512.0], [0.0, 512.0], [1536.0, 512.0], [1024.0, 0.0], [1024.0, -1.0], [np.nan, 5.0]])
    rays, valid = bearings_of_keypoints(camera, places)
    assert valid.tolist() == [True] * 4 + [False] * 2
    np.testing.assert_allclose(rays[:4], [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], atol=1e-12)
    # A pixel near the middle of the image is as wide as a pixel of the pinhole camera with that focal length.
    near, _ = bearings_of_keypoints(camera, np.array([[1025.0, 512.0]]))
    assert near[0, 0] == pytest.approx(1.0 / focal_length(camera), rel=1e-5)


def test_a_graph_of_panoramas_has_a_known_focal_length(tmp_path: Path) -> None:
    scene(tmp_path / "database.db", "EQUIRECTANGULAR", LENSES["EQUIRECTANGULAR"])
    graph = read_view_graph(tmp_path / "database.db")
    assert graph.camera_focal_known is not None
    assert graph.camera_focal_known.all()
    assert graph.camera_focal_lengths is not None
    np.testing.assert_allclose(graph.camera_focal_lengths, 2048.0 / (2 * np.pi))


@pytest.mark.slow
def test_panoramas_from_photographs(tmp_path: Path) -> None:
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=1200, height=600, params=(1200, 600))
    rng = np.random.default_rng(0)
    caster = RayCaster(paint(build_ruin(rng), rng))
    at = [(np.arange(SAMPLES * size) + 0.5) / SAMPLES for size in (1200, 600)]
    grid = np.stack(np.meshgrid(*at), axis=2).reshape(-1, 2)
    rays = np.asarray(camera.cam_ray_from_img(grid)).reshape(SAMPLES * 600, SAMPLES * 1200, 3)
    angle = np.radians(12.0) * np.arange(6)
    centers = np.stack([2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.0 + 0.1 * np.cos(7 * angle)], axis=1)
    rotations = look_at(centers, centers + np.array([1.0, 0.0, 0.0]))
    (tmp_path / "photos").mkdir()
    for k in range(6):
        pixels = photograph(caster, rays, rotations[k], centers[k], np.random.default_rng(k))
        cv2.imwrite(str(tmp_path / "photos" / f"{k}.jpg"), pixels)
    job = ["run", "--image_path", str(tmp_path / "photos"), "--output_path", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*job, "--camera_model", "EQUIRECTANGULAR"])
    assert result.exit_code == 0, result.output
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert model.num_reg_images() == 6
    by_name = {image.name: image.projection_center() for image in model.images.values()}
    distances, _ = align_positions(np.array([by_name[f"{k}.jpg"] for k in range(6)]), centers)
    assert distances.max() < 0.01
    graph = read_view_graph(tmp_path / "out" / "database.db")
    assert graph.inlier_bearings1 is not None
    assert (graph.inlier_bearings1[:, 2] < 0).mean() > 0.3  # the scene is behind the first camera
    assert next(iter(model.cameras.values())).model_name == "EQUIRECTANGULAR"
