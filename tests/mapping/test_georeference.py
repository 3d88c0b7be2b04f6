"""Georeferenced jobs: as exact as the measured positions allow, wrong ones named, and nothing claimed without them."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from measured_positions import by_gps, east_north_up, prior, write_priors
from synthetic_databases import make_database
from typer.testing import CliRunner

from colmap_vg import MappingOptions, SolveOptions, align_positions
from colmap_vg.cli.main import app
from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.geometry.robust_similarity import align_robustly
from colmap_vg.geometry.similarity import align_positions as align_by_least_squares
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.mapping import bundle
from colmap_vg.mapping.georeference import georeference, level_by_gravity, why_not
from colmap_vg.scene.pose_priors import PosePriors
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import SyntheticViews, synthetic_views

NUM_IMAGES, METRES = 40, 10.0


@pytest.fixture(scope="module")
def flight() -> SyntheticViews:
    return synthetic_views("drone", NUM_IMAGES, noise_px=0.5)


@pytest.fixture(scope="module")
def plain(flight: SyntheticViews, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "database.db"
    write_synthetic_database(path, flight)
    return path


def mapped(path: Path, output: Path, **options: Any) -> tuple[MappingResult, list[str]]:
    log = StageLog()
    return map_database(path, None, output, MappingOptions(num_threads=1, **options), log), log.warnings


def errors_in_frame(result: MappingResult, truth: np.ndarray) -> np.ndarray:
    """Distances (n,) of a georeferenced model's cameras from true positions east, north and up of `ORIGIN`."""
    told = result.georeferences[0]
    assert told is not None
    assert told.origin is not None
    expected = np.array([east_north_up(*place, told.origin) for place in by_gps(truth)])
    images = [image for image in result.models[0].images.values() if image.has_pose]
    return np.array([np.linalg.norm(im.projection_center() - expected[int(im.name[:5])]) for im in images])


def test_a_flight_with_wrong_positions(plain: Path, flight: SyntheticViews, tmp_path: Path) -> None:
    path = Path(shutil.copyfile(plain, tmp_path / "database.db"))
    rng, sigma = np.random.default_rng(1), 3.0
    truth = METRES * flight.projection_centers
    measured = truth + sigma * rng.normal(size=truth.shape)
    wrong = np.sort(rng.permutation(NUM_IMAGES)[:4])
    measured[wrong] += 1000.0 * np.array([0.6, 0.8, 0.0])
    write_priors(path, [prior(row + 1, place, "WGS84") for row, place in enumerate(by_gps(measured))])
    result, warnings = mapped(path, tmp_path / "out")
    told = result.georeferences[0]
    assert told is not None
    assert told.frame == "ENU"
    assert told.outliers == tuple(f"{row:05d}.jpg" for row in wrong)
    assert len(told.residuals) == NUM_IMAGES
    assert warnings[0].startswith("4 of 40 measured positions are wrong and not used (first: ")
    errors = errors_in_frame(result, truth)
    assert len(errors) == NUM_IMAGES
    # Seven unknowns from 36 positions: root mean square error sigma sqrt(7 / 36).
    assert np.sqrt(np.mean(errors**2)) < 1.5 * sigma * np.sqrt(7 / 36)
    # Nobody who knows the shape of the flight and which positions are wrong can do better.
    right = np.setdiff1d(np.arange(NUM_IMAGES), wrong)
    _, into_frame = align_by_least_squares(truth[right], measured[right])
    assert abs(np.mean(errors) - np.linalg.norm(into_frame.apply(truth) - truth, axis=1).mean()) < 0.02 * sigma
    np.testing.assert_allclose(told.sigmas, sigma, rtol=0.35)
    name = "00002.jpg"
    image = next(image for image in result.models[0].images.values() if image.name == name)
    expected = east_north_up(*by_gps(measured[2:3])[0], told.origin or (0.0, 0.0, 0.0)) - image.projection_center()
    np.testing.assert_allclose(told.residuals[name], expected, atol=1e-4)


def test_precise_positions_straighten_a_model(plain: Path, flight: SyntheticViews, tmp_path: Path) -> None:
    path = Path(shutil.copyfile(plain, tmp_path / "database.db"))
    truth = METRES * flight.projection_centers
    write_priors(path, [prior(row + 1, place, "WGS84", 1e-3) for row, place in enumerate(by_gps(truth))])
    result, warnings = mapped(path, tmp_path / "out")
    assert warnings == []
    with_priors = np.sqrt(np.mean(errors_in_frame(result, truth) ** 2))
    path = Path(shutil.copyfile(plain, tmp_path / "again.db"))
    write_priors(path, [prior(row + 1, place, "WGS84", 30.0) for row, place in enumerate(by_gps(truth))])
    aligned, _ = mapped(path, tmp_path / "out2")
    assert with_priors < 0.3 * np.sqrt(np.mean(errors_in_frame(aligned, truth) ** 2))


def test_standard_deviations_of_the_caller_replace_those_of_the_database(
    plain: Path, flight: SyntheticViews, tmp_path: Path
) -> None:
    path = Path(shutil.copyfile(plain, tmp_path / "database.db"))
    truth = METRES * flight.projection_centers
    noise = np.random.default_rng(3).normal(size=truth.shape) * [0.01, 0.01, 20.0]
    write_priors(path, [prior(k + 1, x, "WGS84", 10.0) for k, x in enumerate(by_gps(truth + noise))])
    line = ["mapper", "--database_path", str(path), "--output_path", str(tmp_path / "out"), "--report", "0"]
    line += ["--overwrite_priors_covariance", "1", "--PosePrior.prior_position_std_x", "0.01"]
    line += ["--prior_position_std_y", "0.01", "--prior_position_std_z", "20"]
    told = CliRunner().invoke(app, line)
    assert told.exit_code == 0, told.output
    found = json.loads((tmp_path / "out" / "summary.json").read_text())["models"][0]["georeference"]
    # Horizontal residuals are small only where vertical ones, which are two thousand times as uncertain, weigh little.
    assert found["sigmas"][2] == pytest.approx(20.0, rel=0.3)
    residuals = np.array(list(found["residuals"].values()))
    assert np.abs(residuals[:, :2]).max() < 0.2
    assert np.abs(residuals[:, 2]).max() > 10.0


def test_a_straight_flight_is_level(tmp_path: Path) -> None:
    street = synthetic_views("street", 30, noise_px=0.3)
    write_synthetic_database(tmp_path / "database.db", street)
    truth = METRES * street.projection_centers
    measured = truth + 3.0 * np.random.default_rng(0).normal(size=truth.shape)
    write_priors(tmp_path / "database.db", [prior(k + 1, x, "WGS84") for k, x in enumerate(by_gps(measured))])
    result, warnings = mapped(tmp_path / "database.db", tmp_path / "out")
    told = result.georeferences[0]
    assert told is not None
    assert told.level_is_guessed
    assert warnings[-1].startswith("The cameras lie nearly on a line")
    # Image rows are horizontal along this street, so the guess is right to within the noise of the cameras' roll.
    rows = [im.cam_from_world().rotation.matrix()[0, 2] for im in result.models[0].images.values() if im.has_pose]
    assert abs(np.mean(rows)) < 0.05
    down = [im.cam_from_world().rotation.matrix()[1, 2] for im in result.models[0].images.values() if im.has_pose]
    assert np.mean(down) < -0.9
    assert np.sqrt(np.mean(errors_in_frame(result, truth) ** 2)) < 3.0 * np.sqrt(7 / 30) * 1.5


def with_gap(views: SyntheticViews, last: int) -> SyntheticViews:
    """Views with one pair only across the gap behind an image, none of whose points a third image sees."""
    first, second = views.pairs.T
    across = (np.minimum(first, second) <= last) & (np.maximum(first, second) > last)
    kept = np.flatnonzero(~across | ((first == last) & (second == last + 1)))
    keypoints, matches = list(views.keypoints), [views.matches[k] for k in kept]
    own = int(np.flatnonzero(across[kept])[0])
    rows = []
    for side, image in enumerate((last, last + 1)):
        rows.append(len(keypoints[image]) + np.arange(len(matches[own])))
        keypoints[image] = np.concatenate([keypoints[image], keypoints[image][matches[own][:, side]]])
    matches[own] = np.stack(rows, axis=1)
    return replace(
        views,
        keypoints=tuple(keypoints),
        pairs=views.pairs[kept],
        matches=tuple(matches),
        relative_rotations=views.relative_rotations[kept],
        directions=views.directions[kept],
        wrong=views.wrong[kept],
    )


def test_positions_link_what_one_pair_does_not(tmp_path: Path) -> None:
    """The pair tells no scale across the gap of a flight line; the positions do."""
    street = with_gap(synthetic_views("street", 30, noise_px=0.3), 16)
    write_synthetic_database(tmp_path / "database.db", street)
    truth = METRES * street.projection_centers
    measured = truth + 3.0 * np.random.default_rng(0).normal(size=truth.shape)
    write_priors(tmp_path / "database.db", [prior(k + 1, x, "WGS84") for k, x in enumerate(by_gps(measured))])
    result, warnings = mapped(tmp_path / "database.db", tmp_path / "out")
    assert warnings[0].startswith("13 images are linked to the others by one pair only")
    assert list(result.models) == [0]
    errors = errors_in_frame(result, truth)
    assert len(errors) == 30
    assert np.sqrt(np.mean(errors**2)) < 3.0 * np.sqrt(11 / 30) * 1.5
    result, _ = mapped(tmp_path / "database.db", tmp_path / "alone", use_prior_position=False)
    assert [model.num_reg_images() for model in result.models.values()] == [17, 13]


def with_gravity(flight: SyntheticViews, path: Path, share_wrong: float) -> None:
    """Add directions of gravity, 1 degree off, to three quarters of the images; some at random or upside down."""
    rng, priors = np.random.default_rng(2), []
    for row in range(0, NUM_IMAGES * 3 // 4):
        down = flight.cam_from_world_rotations[row] @ [0.0, 0.0, -1.0] + np.radians(1.0) * rng.normal(size=3)
        if rng.random() < share_wrong:
            down = -down if row % 2 else rng.normal(size=3)
        found = pycolmap.PosePrior(gravity=down / np.linalg.norm(down))
        found.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), row + 1)
        priors.append(found)
    write_priors(path, priors)


@pytest.mark.parametrize("share_wrong", [0.0, 0.3])
def test_models_without_positions_are_turned_upright(
    plain: Path, flight: SyntheticViews, tmp_path: Path, share_wrong: float
) -> None:
    path = Path(shutil.copyfile(plain, tmp_path / "database.db"))
    with_gravity(flight, path, share_wrong)
    tilts = []
    for k, options in enumerate(({}, {"solve": SolveOptions(use_prior_gravity=False)})):
        result, _ = mapped(path, tmp_path / str(k), **options)
        assert result.georeferences[0] is None
        images = [image for image in result.models[0].images.values() if image.has_pose]
        truth = flight.projection_centers[[int(image.name[:5]) for image in images]]
        _, similarity = align_positions(np.array([image.projection_center() for image in images]), truth)
        tilts.append(np.degrees(np.arccos(np.clip(similarity.rotation[2, 2], -1.0, 1.0))))
    assert tilts[0] < 3.0 / np.sqrt(NUM_IMAGES / 2)  # thrice the noise of the mean
    assert tilts[1] > 5.0


@pytest.mark.parametrize("down", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-0.6, 0.64, 0.48]])
def test_any_direction_is_turned_down(down: list[float]) -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=5))
    ids = np.array(sorted(model.reg_image_ids()))
    before = {i: model.image(i).cam_from_world().rotation.matrix() for i in ids.tolist()}
    gravities = np.array([before[i] @ down for i in ids.tolist()])
    priors = PosePriors(np.full((len(ids), 3), np.nan), np.full((len(ids), 3, 3), np.nan), gravities)
    assert level_by_gravity(model, priors, ids)
    for i, gravity in zip(ids.tolist(), gravities, strict=True):
        np.testing.assert_allclose(
            model.image(i).cam_from_world().rotation.matrix().T @ gravity, [0.0, 0.0, -1.0], atol=1e-9
        )
    few = replace(priors, gravities=np.where(np.arange(len(ids))[:, None] < 2, gravities, np.nan))
    assert not level_by_gravity(model, few, ids)


@pytest.mark.parametrize("system", ["CARTESIAN", "WGS84"])
def test_colmaps_own_pipeline_test_with_positions(tmp_path: Path, system: str) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=12, num_points3D=200, prior_position=True)
    options.prior_position_coordinate_system = getattr(pycolmap.PosePriorCoordinateSystem, system)
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions(prior_position_stddev=0.05, point2D_stddev=0.5)
        pycolmap.synthesize_noise(noise, truth, database)
    result, _ = mapped(tmp_path / "database.db", tmp_path / "out")
    model = result.models[0]
    assert model.num_reg_images() == 12
    errors = np.array([model.image(i).projection_center() - truth.image(i).projection_center() for i in truth.images])
    if system == "WGS84":  # our origin is another point
        errors -= errors.mean(axis=0)
    assert np.linalg.norm(errors, axis=1).mean() < 0.05


@pytest.mark.parametrize(
    ("kind", "told"),
    [("random", "agree with it|too uncertain"), ("two", "Only 2 images of a model have a measured position")],
)
def test_positions_that_say_nothing_are_not_used(tmp_path: Path, kind: str, told: str) -> None:
    make_database(tmp_path / "database.db", num_images=10, num_points=100, noise_px=0.3)
    rng = np.random.default_rng(0)
    places = rng.normal(size=(10, 3)) if kind == "random" else np.zeros((2, 3))
    write_priors(tmp_path / "database.db", [prior(row + 1, place) for row, place in enumerate(places)])
    result, warnings = mapped(tmp_path / "database.db", tmp_path / "out")
    assert result.georeferences == (None,)
    assert any(re.search(told, warning) for warning in warnings)


def test_it_can_be_switched_off_and_is_told(plain: Path, flight: SyntheticViews, tmp_path: Path) -> None:
    path = Path(shutil.copyfile(plain, tmp_path / "database.db"))
    places = by_gps(METRES * flight.projection_centers)
    write_priors(path, [prior(row + 1, place, "WGS84", 0.5) for row, place in enumerate(places)])
    job = ["mapper", "--database_path", str(path), "--output_path"]
    told = CliRunner().invoke(app, [*job, str(tmp_path / "on")])
    assert told.exit_code == 0, told.output
    assert "metres east, north and up of 47.30" in told.output
    model = json.loads((tmp_path / "on" / "summary.json").read_text())["models"][0]
    assert model["georeference"]["frame"] == "ENU"
    assert "metres east, north and up of" in (tmp_path / "on" / "report.html").read_text(encoding="utf-8")
    off = CliRunner().invoke(app, [*job, str(tmp_path / "off"), "--Mapper.use_prior_position", "0"])
    assert off.exit_code == 0, off.output
    assert "metres east" not in off.output
    assert json.loads((tmp_path / "off" / "summary.json").read_text())["models"][0]["georeference"] is None


def test_a_minority_of_positions_is_no_reason_to_move_a_model() -> None:
    aligned = align_robustly(np.eye(3), 10.0 * np.eye(3))
    few = replace(aligned, right=np.array([True] * 3 + [False] * 4))
    assert why_not(aligned) == ""
    assert why_not(few) == "only 3 of 7 measured positions agree with it"


UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""cam_from_world rotation of a camera that looks north, with its lower side down."""
LOOKING_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""cam_from_world rotation of a camera that looks down, with its upper side north."""


@pytest.mark.parametrize("with_gravity", [False, True])
@pytest.mark.parametrize("true", [UPRIGHT, LOOKING_DOWN], ids=["upright", "looking down"])
def test_the_rotation_about_a_line_is_set_by_gravity_or_level_photographs(true: np.ndarray, with_gravity: bool) -> None:
    """Along a street or a flight with a little sway, measured more roughly than it sways."""
    rng = np.random.default_rng(0)
    sway = np.column_stack([10.0 * np.arange(30), rng.normal(size=(30, 2))])
    model, roll = pycolmap.Reconstruction(), so3.exp(np.array([[1.1, 0.0, 0.0]]))[0]
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", params=[1.0, 0.5, 0.5]))
    for row, center in enumerate(sway @ roll):
        R = true @ roll
        image = pycolmap.Image(name=f"{row}.jpg", camera_id=1, image_id=row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center))
    gravities = np.tile(true @ [0.0, 0.0, -1.0] if with_gravity else [np.nan] * 3, (30, 1))
    priors = PosePriors(sway + 2.0 * rng.normal(size=(30, 3)), np.full((30, 3, 3), np.nan), gravities)
    told = georeference(None, model, priors, np.arange(1, 31), MappingOptions(), StageLog())
    assert told is not None
    assert told.level_is_guessed == (not with_gravity)
    for image in model.images.values():
        turned = image.cam_from_world().rotation.matrix()
        assert np.degrees(np.arccos((turned * true).sum(axis=1))).max() < 3.0


def test_positions_weigh_relative_to_the_keypoints() -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=8, num_points3D=200)
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=2.0), model)
    (weighted,) = bundle._weighted([prior(1, np.zeros(3), sigma=3.0)], model)
    np.testing.assert_allclose(weighted.position_covariance, 9.0 / 4.0 * np.eye(3), rtol=0.25)
