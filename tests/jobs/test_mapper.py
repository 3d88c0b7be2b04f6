"""From synthetic databases to models: compared with the truth, with the database and with themselves."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import (
    PINHOLE,
    centers,
    changed_copy,
    make_database,
    pair_id,
    sha256,
    two_view_tracks_only,
    with_other_ids,
)

from colmap_vg.colmap_io.database import check_database
from colmap_vg.errors import MappingError, OutputError
from colmap_vg.events import StageLog
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.jobs import mapper
from colmap_vg.jobs.mapper import MappingResult, map_database, view_graph_mapping
from colmap_vg.options import MappingOptions
from colmap_vg.scene.edge_residuals import edge_residual_sigmas
from colmap_vg.scene.solution import SolutionStatus
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict
from colmap_vg.solver.solve import solve_view_graph

ONE_THREAD = MappingOptions(num_threads=1)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """Ten images of 200 points, half a pixel of noise."""
    path = tmp_path_factory.mktemp("noisy") / "database.db"
    return path, make_database(path, noise_px=0.5)


def job(path: Path, output: Path, options: MappingOptions = ONE_THREAD) -> tuple[MappingResult, StageLog]:
    log = StageLog()
    return map_database(path, None, output, options, log), log


def files(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): sha256(p) for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_model_is_the_truth_within_the_noise(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    path, truth = noisy
    before = files(path.parent)
    result, log = job(path, tmp_path)
    assert files(path.parent) == before  # the same bytes, and no -wal or -shm beside them
    model = result.models[0]
    ids = sorted(truth.reg_image_ids())
    assert sorted(model.reg_image_ids()) == ids
    errors, _ = align_positions(centers(model, ids), centers(truth, ids))
    # 0.5 px of 1280 at a distance of about 7, by 200 points: 0.5 / 1280 * 7 / sqrt(200) = 2e-4 for a position across
    # the view; the depth of a scene that fills a tenth of it is ten times as uncertain.
    assert errors.max() < 10 * 0.5 / 1280 * 7 / np.sqrt(200) * 2
    assert model.num_points3D() == 200
    assert model.compute_mean_reprojection_error() == pytest.approx(0.5 * np.sqrt(np.pi / 2), rel=0.15)
    assert log.warnings == []
    assert [record.stage for record in log.records] == [
        "view graph",
        "solve",
        "load",
        "triangulate",
        "adjust",
        "register",
        "check",
        "write",
    ]
    written = pycolmap.Reconstruction(tmp_path / "0")
    assert written.num_points3D() == 200
    assert np.array_equal(centers(written, ids), centers(model, ids))


def test_the_solution_is_the_finished_models(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    result, _ = job(noisy[0], tmp_path)
    model, solution, graph = result.models[0], result.solution, result.graph
    assert np.allclose(solution.projection_centers, centers(model, solution.image_ids.tolist()), atol=1e-12)
    assert solution.registered.all()
    assert solution.status == SolutionStatus.SOLVED
    focal = model.camera(1).mean_focal_length()
    assert solution.focal_scales * graph.camera_focal_lengths == pytest.approx(focal, rel=1e-12)
    rotations = np.array([model.image(i).cam_from_world().rotation.matrix() for i in solution.image_ids.tolist()])
    sigmas = edge_residual_sigmas(
        graph.edges,
        graph.cam2_from_cam1_rotations,
        graph.cam2_in_cam1_directions,
        graph.edge_information,
        rotations,
        centers(model, solution.image_ids.tolist()),
    )
    assert np.allclose(solution.edge_residual_sigmas, sigmas, rtol=1e-6)
    assert 0.3 < np.median(sigmas) < 3.0


def test_the_frame_and_scale_are_sane(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    """As pycolmap's normalize leaves it: it has nothing left to do."""
    model = job(noisy[0], tmp_path)[0].models[0]
    ids = sorted(model.reg_image_ids())
    before = centers(model, ids)
    model.normalize()
    assert np.allclose(centers(model, ids), before, atol=1e-9)
    assert 1.0 < np.linalg.norm(np.ptp(before, axis=0)) < 100.0


def test_ids_names_and_keypoints_are_the_databases(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "a.db", num_images=6, num_points=80, noise_px=0.3, camera_per_image=True)
    path = with_other_ids(tmp_path / "a.db", tmp_path / "database.db")
    view_graph_mapping(path, None, tmp_path / "out", ONE_THREAD)
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert {i: image.name for i, image in model.images.items()} == {
        1000 + 3 * i: image.name for i, image in truth.images.items()
    }
    assert {i: image.camera_id for i, image in model.images.items()} == {
        1000 + 3 * i: 50 + image.camera_id for i, image in truth.images.items()
    }
    with pycolmap.Database.open(path) as database:
        for image_id, image in model.images.items():
            pixels = np.array([p.xy for p in image.points2D])
            assert np.array_equal(pixels, database.read_keypoints(image_id)[:, :2].astype(np.float64))


def test_fixed_intrinsics_are_the_databases_to_the_last_bit(tmp_path: Path) -> None:
    params = (1280.123456789, 512.3, 384.7, 0.0123456789)
    make_database(tmp_path / "a.db", num_points=150, noise_px=0.5, camera=("SIMPLE_RADIAL", params))
    options = MappingOptions(num_threads=1, ba_refine_focal_length=False, ba_refine_extra_params=False)
    view_graph_mapping(tmp_path / "a.db", None, tmp_path / "fixed", options)
    assert pycolmap.Reconstruction(tmp_path / "fixed" / "0").camera(1).params.tolist() == list(params)
    view_graph_mapping(tmp_path / "a.db", None, tmp_path / "refined", ONE_THREAD)
    refined = pycolmap.Reconstruction(tmp_path / "refined" / "0").camera(1).params
    assert refined[0] != params[0]
    assert refined[0] == pytest.approx(params[0], rel=5e-3)
    assert refined[3] != params[3]
    assert refined[1:3].tolist() == list(params[1:3])


def test_a_focal_length_that_is_a_little_off_is_refined(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_points=200, noise_px=0.5)
    off = np.array([1280.0 * 1.02, *PINHOLE[1][1:]]).tobytes()
    path = changed_copy(tmp_path / "a.db", tmp_path / "b.db", ("UPDATE cameras SET params = ?", (off,)))
    model = view_graph_mapping(path, None, tmp_path / "out", ONE_THREAD)[0]
    assert model.camera(1).mean_focal_length() == pytest.approx(1280.0, rel=3e-3)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05)),
        ("OPENCV_FISHEYE", (600.0, 600.0, 512.0, 384.0, 0.01, -0.005, 0.001, 0.0)),
    ],
)
def test_cameras_with_distortion(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    truth = make_database(tmp_path / "a.db", noise_px=0.5, camera=(model, params))
    found = view_graph_mapping(tmp_path / "a.db", None, tmp_path / "out", ONE_THREAD)[0]
    ids = sorted(truth.reg_image_ids())
    assert sorted(found.reg_image_ids()) == ids
    errors, _ = align_positions(centers(found, ids), centers(truth, ids))
    assert errors.max() < 10 * 0.5 / params[0] * 7 / np.sqrt(200) * 2


def test_one_thread_gives_the_same_bits(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    for name in ("one", "other"):
        view_graph_mapping(noisy[0], None, tmp_path / name, ONE_THREAD)
    one = files(tmp_path / "one" / "0")
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= set(one)
    assert one == files(tmp_path / "other" / "0")


def test_exact_data_need_no_warning(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "a.db", num_images=8, num_points=100)
    result, log = job(tmp_path / "a.db", tmp_path / "out")
    ids = sorted(truth.reg_image_ids())
    errors, _ = align_positions(centers(result.models[0], ids), centers(truth, ids))
    assert errors.max() < 1e-4
    assert log.warnings == []


# Images that the viewing graph or the points leave out


def test_an_image_without_a_usable_pair_is_registered_by_its_points(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    """COLMAP called all pairs of image 4 panoramic: no direction holds it, but its matches see the model's points."""
    path, truth = noisy
    pairs = ", ".join(str(pair_id(*sorted((4, i)))) for i in range(1, 11) if i != 4)
    path = changed_copy(
        path, tmp_path / "a.db", f"UPDATE two_view_geometries SET config = 5 WHERE pair_id IN ({pairs})"
    )
    result, _ = job(path, tmp_path / "out")
    assert (result.graph.read_verdicts == EdgeVerdict.ROTATION_ONLY).sum() == 9
    assert solve_view_graph(result.graph).image_verdicts[3] == ImageVerdict.NOT_RIGID
    model, ids = result.models[0], sorted(truth.reg_image_ids())
    assert sorted(model.reg_image_ids()) == ids
    assert result.solution.image_verdicts.tolist() == [ImageVerdict.REGISTERED] * 10
    assert result.solution.status == SolutionStatus.SOLVED
    errors, _ = align_positions(centers(model, ids), centers(truth, ids))
    assert errors.max() < 10 * 0.5 / 1280 * 7 / np.sqrt(200) * 2


def test_an_image_that_hangs_on_two_view_tracks_is_left_out_with_its_reason(tmp_path: Path) -> None:
    """The viewing graph fixes it, the points do not: pycolmap.global_mapping leaves such a camera at a random place."""
    make_database(tmp_path / "a.db", num_images=6, num_points=200, noise_px=0.5)
    two_view_tracks_only(tmp_path / "a.db", 6)
    result, _ = job(tmp_path / "a.db", tmp_path / "out")
    assert sorted(result.models[0].reg_image_ids()) == [1, 2, 3, 4, 5]
    solution = result.solution
    assert solution.image_verdicts.tolist() == [ImageVerdict.REGISTERED] * 5 + [ImageVerdict.FEW_OBSERVATIONS]
    assert solution.registered.tolist() == [True] * 5 + [False]
    assert np.isnan(solution.projection_centers[5]).all()
    assert solution.status == SolutionStatus.PARTIAL
    assert "1 few_observations" in solution.message
    written = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert sorted(written.reg_image_ids()) == [1, 2, 3, 4, 5]


def test_no_tracks_of_three_views_is_a_clear_error(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=4, num_points=200, noise_px=0.3)
    for image_id in range(1, 5):
        two_view_tracks_only(tmp_path / "a.db", image_id)
    with pytest.raises(MappingError, match="add overlapping photographs"):
        view_graph_mapping(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(num_threads=1))
    assert not (tmp_path / "out").exists()


def test_two_components_become_two_models(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    path, truth = noisy
    small = (2, 5, 9)
    cut = [pair_id(*sorted((a, b))) for a in small for b in range(1, 11) if b not in small]
    rows = ", ".join(map(str, cut))
    path = changed_copy(path, tmp_path / "a.db", f"DELETE FROM two_view_geometries WHERE pair_id IN ({rows})")
    result, _ = job(path, tmp_path / "out")
    large = [i for i in range(1, 11) if i not in small]
    assert {index: sorted(model.reg_image_ids()) for index, model in result.models.items()} == {
        0: large,
        1: list(small),
    }
    words = dict(zip(result.solution.image_ids.tolist(), result.solution.image_verdicts.tolist(), strict=True))
    assert {words[i] for i in small} == {ImageVerdict.OTHER_MODEL}
    assert {words[i] for i in large} == {ImageVerdict.REGISTERED}
    assert result.solution.status == SolutionStatus.PARTIAL
    assert result.solution.component.tolist() == [1 if i in small else 0 for i in result.solution.image_ids]
    for index, ids in ((0, large), (1, list(small))):
        written = pycolmap.Reconstruction(tmp_path / "out" / str(index))
        assert sorted(written.reg_image_ids()) == ids
        errors, _ = align_positions(centers(written, ids), centers(truth, ids))
        assert errors.max() < 0.05
        rows = np.searchsorted(result.solution.image_ids, ids)
        np.testing.assert_allclose(result.solution.projection_centers[rows], centers(written, ids))


def test_two_images_are_too_few(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=2, num_points=100)
    with pytest.raises(MappingError, match=r"No three images .* add overlapping photographs"):
        view_graph_mapping(tmp_path / "a.db", None, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# The output


@pytest.mark.parametrize("existed", [False, True])
def test_a_failure_in_the_middle_leaves_no_model(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existed: bool
) -> None:
    def fail(*_: object) -> None:
        raise MappingError("the middle")

    if existed:
        (tmp_path / "out").mkdir()
    monkeypatch.setattr(mapper, "build_model", fail)
    with pytest.raises(MappingError, match="the middle"):
        view_graph_mapping(noisy[0], None, tmp_path / "out", ONE_THREAD)
    assert (tmp_path / "out").exists() == existed
    assert not existed or list((tmp_path / "out").iterdir()) == []


def test_a_failure_while_writing_keeps_the_older_model(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OutputError("disk full")

    view_graph_mapping(noisy[0], None, tmp_path / "out", ONE_THREAD)
    before = files(tmp_path / "out" / "0")
    monkeypatch.setattr(mapper, "publish_models", fail)
    with pytest.raises(OutputError, match="disk full"):
        view_graph_mapping(noisy[0], None, tmp_path / "out", MappingOptions(num_threads=1, overwrite=True))
    assert files(tmp_path / "out" / "0") == before


def test_an_older_model_is_replaced_whole_and_only_when_asked(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    for index in range(2):
        (tmp_path / str(index)).mkdir()
        for name in ("cameras.txt", "notes.txt"):
            (tmp_path / str(index) / name).write_text("old")
    with pytest.raises(OutputError, match="overwrite=True"):
        view_graph_mapping(noisy[0], None, tmp_path, ONE_THREAD)
    assert (tmp_path / "1" / "cameras.txt").read_text() == "old"
    view_graph_mapping(noisy[0], None, tmp_path, MappingOptions(num_threads=1, overwrite=True))
    assert not (tmp_path / "1").exists()
    assert not (tmp_path / "0" / "cameras.txt").exists()
    assert not (tmp_path / "0" / "notes.txt").exists()
    assert pycolmap.Reconstruction(tmp_path / "0").num_reg_images() == 10


def test_the_work_folder_holds_nothing_afterwards(noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    view_graph_mapping(noisy[0], None, tmp_path, ONE_THREAD)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".work", "0"]
    assert list((tmp_path / ".work").iterdir()) == []


def test_a_database_of_one_trivial_rig_per_camera_is_fine(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=4, num_points=60, camera_per_image=True)
    check_database(tmp_path / "a.db")


def test_library_calls_are_quiet_and_leave_the_log_s_level(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 0
    try:
        view_graph_mapping(noisy[0], None, tmp_path / "out")
        assert pycolmap.logging.minloglevel == 0
    finally:
        pycolmap.logging.minloglevel = level
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("ratio", "trials"), [(0.5, [True, False, False]), (0.99, [True])], ids=["better", "same"])
def test_separate_lenses_are_tried_briefly_and_adjusted_to_the_end_where_they_are_better(
    ratio: float, trials: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, tried, separated = [], [], pycolmap.Reconstruction()
    ratios = iter([ratio, 0.5 * mapper.CONVERGED_COST_RATIO, 1.0])

    def adjusted(_: object, model: pycolmap.Reconstruction, *__: object, rough: bool = False) -> float:
        assert model is not separated
        tried.append(model)
        asked.append(rough)
        return next(ratios)

    monkeypatch.setattr(mapper, "adjust_once_more", adjusted)
    monkeypatch.setattr(mapper, "with_database_cameras", lambda *_: separated)
    log = StageLog()
    with log.stage("lenses"):
        result = mapper._with_database_cameras(None, pycolmap.Reconstruction(), {}, ONE_THREAD, log)
    assert asked == trials
    assert all(model is tried[0] for model in tried)
    assert result is (tried[0] if ratio < mapper.SHARED_LENS_COST_RATIO else separated)
