"""Distortion that only solving finds: pairs are estimated again with it, with results as if it were known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_vg import MappingOptions, SolutionStatus, align_positions
from colmap_vg.colmap_io.tables import read_tables
from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.jobs.graph import lenses_to_read_with, read_job_graph, solve_job_graph
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.reading.found_lenses import FoundLenses, with_found_lenses
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import SyntheticViews, synthetic_views

TERM, GUESS = -0.1, 1.2
OPTIONS = MappingOptions(num_threads=1, extract_colors=False)


def bend(path: Path, prior: bool) -> None:
    """Distort the keypoints of a database without telling its camera, which knows its focal length or guesses it."""
    with pycolmap.Database.open(path) as database:
        camera = database.read_all_cameras()[0]
        f, x, y = camera.params
        lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=camera.width, height=camera.height, params=[f, x, y, TERM])
        for image in database.read_all_images():
            pixels = database.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            rays = np.concatenate([camera.cam_from_img(pixels), np.ones((len(pixels), 1))], axis=1)
            database.update_keypoints(image.image_id, np.asarray(lens.img_from_cam(rays), dtype=np.float32))
        lens.camera_id, lens.has_prior_focal_length = camera.camera_id, prior
        lens.params = [f if prior else GUESS * f, x, y, 0.0]
        database.update_camera(lens)


@pytest.fixture(scope="module")
def views() -> SyntheticViews:
    return synthetic_views("drone", 36, noise_px=0.5)


@pytest.fixture(scope="module")
def databases(views: SyntheticViews, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """With a known lens, and with distorted ones of an unknown and of a known focal length."""
    folder = tmp_path_factory.mktemp("lenses")
    for name in ("known.db", "bent.db", "stated.db"):
        write_synthetic_database(folder / name, views)
    bend(folder / "bent.db", prior=False)
    bend(folder / "stated.db", prior=True)
    return folder / "known.db", folder / "bent.db", folder / "stated.db"


def mean_error(found: MappingResult, views: SyntheticViews) -> float:
    model = found.models[0]
    ids = np.array(sorted(model.reg_image_ids()))
    centers = np.array([model.image(i).projection_center() for i in ids])
    return float(align_positions(centers, views.projection_centers[ids - 1])[0].mean())


@pytest.mark.parametrize("stated", [False, True])
def test_a_distorted_lens_costs_little_accuracy_and_no_trust(
    stated: bool, views: SyntheticViews, databases: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    known, bent = databases[0], databases[1 + stated]
    log = StageLog()
    found, calibrated = (
        map_database(bent, None, tmp_path / "b", OPTIONS, log),
        map_database(known, None, tmp_path / "k", OPTIONS, StageLog()),
    )
    assert sum("estimated again" in warning for warning in log.warnings) == 1
    assert found.solution.status == SolutionStatus.SOLVED
    assert found.solution.agreement[0].inliers > 0.95
    assert found.models[0].num_reg_images() == 36
    f, _, _, term = found.models[0].camera(1).params
    assert f == pytest.approx(views_focal(known), rel=1e-3)
    assert term == pytest.approx(TERM, abs=2e-3)
    assert mean_error(found, views) < 1.5 * mean_error(calibrated, views)
    turned = so3.angle(
        found.graph.cam2_from_cam1_rotations @ np.swapaxes(views_rotations(views, found.graph.edges), 1, 2)
    )
    assert np.degrees(np.median(turned)) < 0.3


def views_focal(path: Path) -> float:
    return float(read_tables(path).cameras[0].params[0])


def views_rotations(views: SyntheticViews, edges: np.ndarray) -> np.ndarray:
    R = views.cam_from_world_rotations
    return R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)


def test_only_solutions_with_distortion_that_few_pairs_agree_with_are_read_again(
    databases: tuple[Path, Path, Path],
) -> None:
    known, bent, _ = databases
    graph = read_job_graph(known, OPTIONS, StageLog())
    assert lenses_to_read_with(graph, solve_job_graph(graph, OPTIONS, StageLog()), OPTIONS) is None
    graph = read_job_graph(bent, OPTIONS, StageLog())
    solution = solve_job_graph(graph, OPTIONS, StageLog())
    lenses = lenses_to_read_with(graph, solution, OPTIONS)
    assert lenses is not None
    assert lenses.focal_lengths == pytest.approx(views_focal(known), rel=0.01)
    agreement = (replace(solution.agreement[0], inliers=0.95),)
    assert lenses_to_read_with(graph, replace(solution, agreement=agreement, arrangements=()), OPTIONS) is None
    several = (solution.cam_from_world_rotations,) * 2
    assert lenses_to_read_with(graph, replace(solution, agreement=agreement, arrangements=several), OPTIONS) is not None
    assert lenses_to_read_with(graph, replace(solution, radial_terms=None), OPTIONS) is None
    fixed = replace(OPTIONS, ba_refine_extra_params=False)
    assert lenses_to_read_with(graph, solution, fixed) is None
    assert not lenses.verified_anew.any()
    anew = replace(graph, verified_anew=np.arange(graph.num_edges) % 3 > 0)
    again = lenses_to_read_with(anew, solution, OPTIONS)
    assert again is not None
    assert again.verified_anew.all()


def test_found_lenses_replace_the_cameras_and_the_matrices_of_their_pairs(databases: tuple[Path, Path, Path]) -> None:
    tables = read_tables(databases[1])
    second = pycolmap.Camera(tables.cameras[0].todict())
    second.camera_id, second.model, second.params = 2, pycolmap.CameraModelId.PINHOLE, [1000.0, 1000.0, 800.0, 600.0]
    camera_idx = np.arange(36) % 2
    two = replace(tables, cameras=(*tables.cameras, second), camera_idx=camera_idx)
    f = tables.cameras[0].params[0]
    lenses = FoundLenses(
        np.array([0.8 * f, 1000.0]), np.array([-0.08, 0.3]), np.array([-0.02, 0.0]), np.zeros(2, dtype=bool)
    )
    found, terms, changed = with_found_lenses(two, databases[1], lenses)
    assert changed.tolist() == [True, False]
    # Terms grow with the square of the focal length; a pinhole camera has none.
    assert terms.tolist() == pytest.approx([-0.02 - 0.08 / 0.64, 0.0])
    assert found.cameras[0].params.tolist() == pytest.approx([0.8 * f, 800.0, 600.0, -0.0128 - 0.08])
    assert found.cameras[1].params.tolist() == second.params.tolist()
    of_first = (camera_idx[two.pairs] == 0).any(axis=1)
    assert np.isnan(found.F[of_first]).all()
    np.testing.assert_array_equal(found.F[~of_first], two.F[~of_first])
    assert np.isfinite(two.F).all()
    np.testing.assert_array_equal(found.matches, two.matches)
    cut = replace(two, matches=two.matches[::2].copy(), offsets=(two.offsets + 1) // 2)
    for anew in (False, True):
        seen, _, _ = with_found_lenses(cut, databases[1], replace(lenses, verified_anew=np.array([anew, True])))
        sizes = np.where(of_first & anew, np.diff(two.offsets), np.diff(cut.offsets))
        np.testing.assert_array_equal(np.diff(seen.offsets), sizes)
