"""Lenses with given calibrations, seen wide: believed where they are right, kept where that is asked, never dropped."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from lens_rooms import NUM_IMAGES, WIDTH, camera, write_room
from synthetic_databases import centers, make_database

from colmap_vg import MappingOptions, ReadOptions, SolutionStatus, align_positions, read_view_graph, solve_view_graph
from colmap_vg.colmap_io.reconstruction import loaded_cache, reconstruction_from_solution
from colmap_vg.errors import MappingError
from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database
from colmap_vg.reading.distortion import undistorted
from colmap_vg.solver import adjustment_stage

LENSES = {
    "SIMPLE_RADIAL": (450.0, 600.0, 450.0, -0.1),
    "RADIAL": (600.0, 600.0, 450.0, -0.25, 0.05),
    "PINHOLE": (600.0, 780.0, 600.0, 450.0),
    "OPENCV": (600.0, 600.0, 600.0, 450.0, -0.25, 0.05, 0.0, 0.0),
    "FULL_OPENCV": (600.0, 600.0, 600.0, 450.0, -0.25, 0.05, 0.0, 0.0, 0.002, 0.0, 0.0, 0.0),
    "FOV": (600.0, 600.0, 600.0, 450.0, 0.9),
    "EUCM": (600.0, 600.0, 600.0, 450.0, 0.6, 1.1),
    "OPENCV_FISHEYE": (450.0, 450.0, 600.0, 450.0, 0.02, -0.004, 0.0, 0.0),
}


@pytest.mark.parametrize("model", LENSES)
def test_a_right_calibration_is_believed(model: str, tmp_path: Path) -> None:
    lens = camera(model, LENSES[model])
    truth = write_room(tmp_path / "a.db", lens, lens)
    graph = read_view_graph(tmp_path / "a.db")
    assert graph.camera_focal_known.all()
    assert graph.camera_focal_lengths[0] == lens.mean_focal_length()
    for refine in (False, True):
        options = MappingOptions(ba_refine_focal_length=refine, ba_refine_extra_params=refine)
        log = StageLog()
        result = map_database(tmp_path / "a.db", None, tmp_path / f"out{refine}", options, log)
        ids = sorted(result.models[0].reg_image_ids())
        assert ids == list(range(1, NUM_IMAGES + 1))
        errors, _ = align_positions(centers(result.models[0], ids), truth)
        assert errors.mean() < 0.005 * 1.5
        assert not log.warnings
        if not refine:
            assert list(result.models[0].camera(1).params) == list(LENSES[model])


def test_a_wrong_focal_length_that_must_stay_stays_with_a_warning(tmp_path: Path) -> None:
    stored = camera("PINHOLE", (800.0, 800.0, 600.0, 450.0))
    write_room(tmp_path / "a.db", camera("PINHOLE", (600.0, 600.0, 600.0, 450.0)), stored)
    log = StageLog()
    options = MappingOptions(ba_refine_focal_length=False, ba_refine_extra_params=False)
    result = map_database(tmp_path / "a.db", None, tmp_path / "out", options, log)
    assert list(result.models[0].camera(1).params) == list(stored.params)
    (told,) = [warning for warning in log.warnings if "kept as requested" in warning]
    assert "not the 800.0 px" in told
    free = map_database(tmp_path / "a.db", None, tmp_path / "free", MappingOptions(), StageLog())
    assert abs(free.models[0].camera(1).mean_focal_length() - 600.0) < 6.0


@pytest.mark.parametrize(
    ("focal", "term", "prior"), [(600.0, -0.2, True), (600.0, -0.2, False), (900.0, -0.2, True), (900.0, 0.0, True)]
)
def test_distortion_that_nobody_told_is_found(focal: float, term: float, prior: bool, tmp_path: Path) -> None:
    lens = camera("SIMPLE_RADIAL", (focal, 600.0, 450.0, term))
    stored = camera("SIMPLE_RADIAL", (focal if prior else 1.2 * WIDTH, 600.0, 450.0, 0.0))
    stored.has_prior_focal_length = prior
    truth = write_room(tmp_path / "a.db", lens, stored)
    log = StageLog()
    result = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), log)
    ids = sorted(result.models[0].reg_image_ids())
    assert ids == list(range(1, NUM_IMAGES + 1))
    errors, _ = align_positions(centers(result.models[0], ids), truth)
    assert errors.mean() < 0.006 * 1.5
    found = result.models[0].camera(1)
    assert abs(found.params[3] - term) < 0.01
    assert abs(found.params[0] / focal - 1.0) < 0.01
    assert any("has no distortion" in warning for warning in log.warnings) == (term != 0.0)


def test_poses_without_points_have_the_lens_that_was_found(tmp_path: Path) -> None:
    stored = camera("SIMPLE_RADIAL", (600.0, 600.0, 450.0, 0.0))
    write_room(tmp_path / "a.db", camera("SIMPLE_RADIAL", (600.0, 600.0, 450.0, -0.2)), stored)
    graph = read_view_graph(tmp_path / "a.db")
    assert abs(graph.found_radial_terms[0] + 0.2) < 0.03
    before = (tmp_path / "a.db").read_bytes()
    with loaded_cache(tmp_path / "a.db", tmp_path, 15, graph=graph) as (cache, _):
        assert cache.camera(1).params[3] == pytest.approx(graph.found_radial_terms[0])
    assert (tmp_path / "a.db").read_bytes() == before


def test_a_radial_term_that_the_solver_finds_reaches_the_camera(tmp_path: Path) -> None:
    stored = camera("SIMPLE_RADIAL", (1.2 * WIDTH, 600.0, 450.0, 0.0))
    stored.has_prior_focal_length = False
    write_room(tmp_path / "a.db", camera("SIMPLE_RADIAL", (600.0, 600.0, 450.0, -0.1)), stored)
    graph = read_view_graph(tmp_path / "a.db", ReadOptions(find_distortion=False))
    solution = solve_view_graph(graph)
    assert solution.registered.all()
    focal, term = graph.camera_focal_lengths[0] * solution.focal_scales[0], solution.radial_terms[0]
    assert abs(focal / 600.0 - 1.0) < 0.01
    assert abs(term + 0.1) < 0.005
    with loaded_cache(tmp_path / "a.db", tmp_path, 15, graph=graph) as (cache, _):
        model = reconstruction_from_solution(cache, solution, graph)
    np.testing.assert_allclose(model.camera(1).params, [focal, 600.0, 450.0, term], rtol=1e-12)


def test_distortion_is_not_looked_for_where_it_must_stay(tmp_path: Path) -> None:
    stored = camera("SIMPLE_RADIAL", (600.0, 600.0, 450.0, 0.0))
    write_room(tmp_path / "a.db", camera("SIMPLE_RADIAL", (600.0, 600.0, 450.0, -0.1)), stored)
    options = MappingOptions(ba_refine_extra_params=False, ba_refine_focal_length=False)
    result = map_database(tmp_path / "a.db", None, tmp_path / "out", options, StageLog())
    assert list(result.models[0].camera(1).params) == list(stored.params)


@pytest.mark.parametrize("kappa", [-0.3, -0.05, 0.0, 0.2])
def test_undistorted_points_distort_back(kappa: float) -> None:
    u = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    r = np.linalg.norm(u, axis=1, keepdims=True)
    assert np.allclose(undistorted(u * (1.0 + kappa * r**2), kappa), u, atol=1e-9)
    if kappa < 0:
        assert np.isnan(undistorted(np.array([[0.0, 5.0]]), kappa)).all()


@pytest.mark.parametrize(("given", "told"), [(True, "kept at their initial values"), (False, "they are set to 0")])
@pytest.mark.parametrize("model", ["FULL_OPENCV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_coefficients_that_run_away_are_taken_back(model: str, given: bool, told: str, tmp_path: Path) -> None:
    """Narrow views tell no terms of high order: bundle adjustment plays them against each other."""
    size = {"FULL_OPENCV": 8, "THIN_PRISM_FISHEYE": 8, "RAD_TAN_THIN_PRISM_FISHEYE": 12}[model]
    params = (2600.0, 2600.0, 512.0, 384.0) + (0.001,) * size
    truth = make_database(tmp_path / "a.db", num_images=8, num_points=60, noise_px=0.5, camera=(model, params))
    if not given:
        with pycolmap.Database.open(tmp_path / "a.db") as database:
            lens = database.read_all_cameras()[0]
            lens.params = [*params[:4], *[0.0] * size]
            database.update_camera(lens)
    log = StageLog()
    found = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), log).models[0]
    lens, ids = found.camera(1), sorted(truth.reg_image_ids())
    assert lens.model_name == model
    assert len(lens.params) == len(params)
    assert np.abs(lens.params[4:]).max() < 1.0
    assert any(told in warning and model in warning for warning in log.warnings)
    assert not any("inside the images only" in warning for warning in log.warnings)
    true_centers = centers(truth, ids)
    errors, _ = align_positions(centers(found, ids), true_centers)
    assert errors.mean() < 1e-3 * np.linalg.norm(true_centers - true_centers.mean(axis=0), axis=1).mean()
    if given:
        assert list(lens.params[4:]) == list(params[4:])


def test_coefficients_that_the_photographs_tell_are_found_without_a_warning(tmp_path: Path) -> None:
    params = (2600.0, 2600.0, 512.0, 384.0, -0.05, 0.01, 0.0, 0.0)
    make_database(tmp_path / "a.db", num_images=8, num_points=60, noise_px=0.5, camera=("OPENCV", params))
    log = StageLog()
    map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), log)
    assert not log.warnings


@pytest.mark.parametrize("model", ["OPENCV", "FOV"])
def test_lenses_far_from_where_they_start_are_adjusted_to_the_end(model: str, tmp_path: Path) -> None:
    """One radial term stands for the lens at first; the focal length is 5 to 60 % off then."""
    params = {"OPENCV": (600.0, 612.0, 600.0, 450.0, -0.12, 0.02, 0.001, -0.001), "FOV": LENSES["FOV"]}[model]
    stored = camera(
        model, {"OPENCV": (1440.0, 1440.0, 600.0, 450.0, *[0.0] * 4), "FOV": (780.0, 780.0, 600.0, 450.0, 0.01)}[model]
    )
    truth = write_room(tmp_path / "a.db", camera(model, params), stored)
    found = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), StageLog()).models[0]
    ids = sorted(found.reg_image_ids())
    assert ids == list(range(1, NUM_IMAGES + 1))
    errors, _ = align_positions(centers(found, ids), truth)
    assert errors.mean() < 0.003 * 1.5
    assert np.allclose(found.camera(1).params[:2], params[:2], rtol=0.01)


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_pixels_that_are_not_square_are_found_without_a_prior(noise_px: float, tmp_path: Path) -> None:
    """Without noise the votes of pairs seem exact, while all of them are wrong by what one focal length leaves out."""
    stored = camera("PINHOLE", (1440.0, 1440.0, 600.0, 450.0))
    stored.has_prior_focal_length = False
    truth = write_room(tmp_path / "a.db", camera("PINHOLE", (1040.0, 1092.0, 600.0, 450.0)), stored, noise_px, seed=1)
    graph = read_view_graph(tmp_path / "a.db")
    assert abs(graph.camera_focal_lengths[0] / 1066.0 - 1.0) < 0.08
    found = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), StageLog()).models[0]
    ids = sorted(found.reg_image_ids())
    assert ids == list(range(1, NUM_IMAGES + 1))
    errors, _ = align_positions(centers(found, ids), truth)
    assert errors.mean() < 0.01 * 1.5


@pytest.mark.parametrize(("angle", "factor"), [(0.6, 1.3), (0.6, 1.0), (0.01, 1.0), (0.01, 1.3)])
def test_the_distortion_of_an_fov_lens_is_found_from_none(angle: float, factor: float, tmp_path: Path) -> None:
    focal = 600.0 / np.tan(np.radians(30.0))
    lens = camera("FOV", (focal, focal, 600.0, 450.0, angle))
    stored = camera("FOV", (factor * focal, factor * focal, 600.0, 450.0, 0.01))
    truth = write_room(tmp_path / "a.db", lens, stored)
    log = StageLog()
    models = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(num_threads=1), log).models
    ids = sorted(models[0].reg_image_ids())
    assert ids == list(range(1, NUM_IMAGES + 1))
    errors, _ = align_positions(centers(models[0], ids), truth)
    assert errors.mean() < 0.005 * 1.5
    assert abs(models[0].camera(1).params[4]) == pytest.approx(angle, abs=0.2)
    assert not any("distortion coefficients" in warning for warning in log.warnings)


def test_uncertain_positions_stay_doubtful_in_finished_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = camera("SIMPLE_PINHOLE", (600.0, 600.0, 450.0))
    write_room(tmp_path / "a.db", lens, lens)
    monkeypatch.setattr(adjustment_stage, "SMALL_ANGLE_DEG", 180.0)
    monkeypatch.setattr(adjustment_stage, "MAX_POSITION_SIGMA", 0.0)
    result = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(num_threads=1), StageLog())
    assert len(result.models[0].reg_image_ids()) == NUM_IMAGES
    assert result.solution.status == SolutionStatus.DOUBTFUL


@pytest.mark.parametrize(("moved", "noise_px", "doubtful"), [(0.04, 0.5, True), (0.04, 0.0, False), (0.4, 0.5, False)])
def test_a_camera_on_a_tripod_is_doubted(moved: float, noise_px: float, doubtful: bool, tmp_path: Path) -> None:
    lens = camera("SIMPLE_PINHOLE", (600.0, 600.0, 450.0))
    truth = write_room(tmp_path / "a.db", lens, lens, noise_px, tripod=moved)
    solution = solve_view_graph(read_view_graph(tmp_path / "a.db"))
    seen = solution.registered
    errors, _ = align_positions(solution.projection_centers[seen], truth[seen])
    assert (errors.mean() > 0.04 * moved) == doubtful
    assert (solution.status == SolutionStatus.DOUBTFUL) == doubtful
    assert (solution.uncertain is not None and solution.uncertain[seen].all()) == doubtful
    assert any("moved too little" in caveat for caveat in solution.caveats) == doubtful
    assert ("The positions are hardly known" in solution.message) == doubtful
    assert solution.position_covariances is None
    if moved < 0.1:  # under a degree no point is triangulated
        with pytest.raises(MappingError, match="sufficient triangulation angle"):
            map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(num_threads=1), StageLog())
