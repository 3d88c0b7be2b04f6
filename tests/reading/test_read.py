"""Viewing graphs of databases against the truth that these were made from."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import (
    angle,
    changed_copy,
    look_at,
    make_database,
    pair_id,
    relative_pose,
    sha256,
    with_other_ids,
    write_views,
)

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.options import ReadOptions
from colmap_vg.reading.read import read_view_graph, read_with_caveats
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph

DEGENERATE, CALIBRATED, UNCALIBRATED, PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC, WATERMARK = range(1, 8)
MULTIPLE, CALIBRATED_RIG = 8, 9


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """Six images without noise (but for float32 pixels), pairs with E and F, without stored poses."""
    path = tmp_path_factory.mktemp("exact") / "database.db"
    return path, make_database(path, num_images=6, num_points=100)


def true_edges(graph: ViewGraph, truth: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    ids = graph.image_ids
    pairs = [relative_pose(truth, int(ids[i]), int(ids[j])) for i, j in graph.edges]
    return np.array([R for R, _ in pairs]), np.array([d for _, d in pairs])


def largest_errors(graph: ViewGraph, truth: pycolmap.Reconstruction) -> tuple[float, float]:
    """Largest error of a rotation and of a direction, radians."""
    R, d = true_edges(graph, truth)
    rotation, direction = angle(graph.cam2_from_cam1_rotations, R), angle(graph.cam2_in_cam1_directions, d)
    return float(rotation.max()), float(direction.max())


@pytest.mark.parametrize("camera_per_image", [False, True])
@pytest.mark.parametrize(
    "camera",
    [
        ("SIMPLE_PINHOLE", (1280.0, 512.0, 384.0)),
        ("PINHOLE", (1280.0, 1100.0, 500.0, 400.0)),
        ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05)),
        ("OPENCV_FISHEYE", (600.0, 600.0, 512.0, 384.0, 0.01, -0.005, 0.001, 0.0)),
    ],
    ids=lambda camera: camera[0],
)
def test_without_noise_relative_poses_are_exact(
    tmp_path: Path, camera: tuple[str, tuple[float, ...]], camera_per_image: bool
) -> None:
    truth = make_database(
        tmp_path / "a.db", num_images=5, num_points=80, camera=camera, camera_per_image=camera_per_image
    )
    graph = read_view_graph(tmp_path / "a.db")
    rotation, direction = largest_errors(graph, truth)
    assert max(rotation, direction) < 1e-6
    assert (graph.read_verdicts == EdgeVerdict.KEPT).all()
    assert (graph.num_inliers == 80).all()


def test_errors_are_as_large_as_the_information_says(tmp_path: Path) -> None:
    """Normalised errors e^T I e of 190 edges against chi-squared with five degrees of freedom (mean 5)."""
    truth = make_database(tmp_path / "a.db", num_images=20, num_points=150, noise_px=1.0)
    graph = read_view_graph(tmp_path / "a.db")
    R, d = true_edges(graph, truth)
    turn = so3.log(R @ np.swapaxes(graph.cam2_from_cam1_rotations, 1, 2))
    shift = np.einsum("kab,ka->kb", tangent_basis(graph.cam2_in_cam1_directions), d)
    error = np.concatenate([turn, shift], axis=1)
    normalised = np.einsum("ka,kab,kb->k", error, graph.edge_information, error)
    assert 4.0 < normalised.mean() < 6.5
    assert 3.4 < np.median(normalised) < 5.5  # chi-squared: 4.35


def test_ids_names_and_cameras_are_the_databases(exact: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    truth = make_database(tmp_path / "a.db", num_images=5, num_points=60, camera_per_image=True)
    path = with_other_ids(tmp_path / "a.db", tmp_path / "b.db")
    before = sha256(path)
    graph = read_view_graph(path)
    assert sha256(path) == before
    assert graph.image_ids.tolist() == [1003, 1006, 1009, 1012, 1015]
    assert graph.image_names == tuple(truth.image(i).name for i in range(1, 6))
    assert graph.camera_ids.tolist() == [51, 52, 53, 54, 55]
    assert graph.camera_ids[graph.camera_idx].tolist() == [50 + truth.image(i).camera_id for i in range(1, 6)]
    assert graph.camera_focal_lengths.tolist() == [1280.0] * 5
    assert graph.camera_focal_known.all()
    assert graph.edges.tolist() == [[i, j] for i in range(5) for j in range(i + 1, 5)]
    plain = read_view_graph(tmp_path / "a.db")
    assert np.array_equal(graph.cam2_from_cam1_rotations, plain.cam2_from_cam1_rotations)
    assert np.array_equal(graph.cam2_in_cam1_directions, plain.cam2_in_cam1_directions)


def test_inlier_bearings_are_rays_of_the_matched_keypoints(exact: tuple[Path, pycolmap.Reconstruction]) -> None:
    path, truth = exact
    graph = read_view_graph(path)
    for k, (i, j) in enumerate(graph.edges):
        rows = slice(graph.inlier_offsets[k], graph.inlier_offsets[k + 1])
        for row, keypoints, bearings in (
            (i, graph.inlier_keypoints1[rows], graph.inlier_bearings1[rows]),
            (j, graph.inlier_keypoints2[rows], graph.inlier_bearings2[rows]),
        ):
            image = truth.image(int(graph.image_ids[row]))
            pixels = np.array([image.points2D[q].xy for q in keypoints])
            assert np.allclose(image.camera.img_from_cam(bearings), pixels, atol=1e-3)
    thinned = read_view_graph(path, ReadOptions(max_num_inliers_per_edge=30))
    assert (np.diff(thinned.inlier_offsets) == 30).all()
    assert np.array_equal(thinned.num_inliers, graph.num_inliers)


def test_poses_of_pairs_are_refined_by_as_many_matches_as_asked_for(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=4, num_points=300, noise_px=0.5)
    every, some = (read_view_graph(tmp_path / "a.db", ReadOptions(max_matches_per_pose=n)) for n in (1000, 30))
    rotations = [np.trace(graph.edge_information[:, :3, :3], axis1=1, axis2=2) for graph in (every, some)]
    assert (every.num_inliers == 300).all()
    assert 5.0 < np.median(rotations[0] / rotations[1]) < 20.0
    assert np.array_equal(some.inlier_offsets, every.inlier_offsets)
    # A pair has as many matches as its list, not as its pose is refined by.
    options = ReadOptions(max_matches_per_pose=30, min_num_inliers=200)
    strict = read_view_graph(tmp_path / "a.db", options)
    assert np.array_equal(strict.cam2_from_cam1_rotations, some.cam2_from_cam1_rotations)


def test_the_graph_is_the_same_to_the_bit(exact: tuple[Path, pycolmap.Reconstruction]) -> None:
    one, other = read_view_graph(exact[0]), read_view_graph(exact[0])
    for name, value in vars(one).items():
        assert np.array_equal(value, getattr(other, name)), name


# What COLMAP found a pair to be


@pytest.mark.parametrize(
    ("config", "verdict"),
    [
        (0, EdgeVerdict.KEPT),
        (DEGENERATE, EdgeVerdict.DEGENERATE),
        (CALIBRATED, EdgeVerdict.KEPT),
        (UNCALIBRATED, EdgeVerdict.KEPT),
        (PLANAR, EdgeVerdict.KEPT),
        (PANORAMIC, EdgeVerdict.ROTATION_ONLY),
        (PLANAR_OR_PANORAMIC, EdgeVerdict.KEPT),
        (WATERMARK, EdgeVerdict.WATERMARK),
        (MULTIPLE, EdgeVerdict.KEPT),
        (CALIBRATED_RIG, EdgeVerdict.KEPT),
    ],
)
def test_each_configuration_has_its_verdict(
    exact: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, config: int, verdict: EdgeVerdict
) -> None:
    path = changed_copy(
        exact[0],
        tmp_path / "a.db",
        f"UPDATE two_view_geometries SET config = {config} WHERE pair_id = {pair_id(2, 5)}",
    )
    graph = read_view_graph(path)
    edge = graph.edges.tolist().index([1, 4])
    assert graph.read_verdicts[edge] == verdict
    assert (np.delete(graph.read_verdicts, edge) == EdgeVerdict.KEPT).all()
    assert graph.planar.tolist() == [k == edge and config in (PLANAR, PLANAR_OR_PANORAMIC) for k in range(15)]
    if verdict == EdgeVerdict.KEPT:
        assert max(largest_errors(graph, exact[1])) < 1e-6


def test_few_inliers_are_in_the_graph_but_not_used(exact: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    rows = f"WHERE pair_id = {pair_id(1, 2)}"
    path = changed_copy(
        exact[0], tmp_path / "a.db", f"UPDATE two_view_geometries SET rows = 14, data = substr(data, 1, 112) {rows}"
    )
    graph = read_view_graph(path)
    assert graph.num_edges == 15
    assert graph.num_inliers.tolist() == [14] + [100] * 14
    assert graph.read_verdicts.tolist() == [EdgeVerdict.FEW_INLIERS] + [EdgeVerdict.KEPT] * 14
    assert not graph.has_rotation[0]
    graph = read_view_graph(path, ReadOptions(min_num_inliers=14))
    assert graph.read_verdicts[0] == EdgeVerdict.KEPT


def test_uncalibrated_pairs_without_a_focal_length_are_the_data(tmp_path: Path) -> None:
    """COLMAP's guess is 20 % off; the pairs' fundamental matrices tell the focal length."""
    truth = make_database(tmp_path / "a.db", num_images=8, num_points=150, has_prior_focal_length=False)
    path = changed_copy(
        tmp_path / "a.db",
        tmp_path / "b.db",
        ("UPDATE cameras SET params = ?", (np.array([1024.0, 512.0, 384.0]).tobytes(),)),
        "UPDATE two_view_geometries SET config = 3, E = NULL",
    )
    graph, _ = read_with_caveats(path, ReadOptions())
    assert (graph.read_verdicts == EdgeVerdict.KEPT).all()
    assert graph.camera_focal_lengths[0] == pytest.approx(1280.0, rel=0.01)
    assert not graph.camera_focal_known[0]
    assert max(largest_errors(graph, truth)) < np.radians(0.5)


def test_a_false_uncalibrated_pair_is_refused(exact: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    """With known focal lengths, a pair that only a fundamental matrix explains; here nothing explains it."""
    path = tmp_path / "a.db"
    path.write_bytes(exact[0].read_bytes())
    with pycolmap.Database.open(path) as database:
        geometry = database.read_two_view_geometry(1, 2)
        shuffled = geometry.inlier_matches.copy()
        shuffled[:, 1] = np.random.default_rng(0).permutation(shuffled[:, 1])
        geometry.inlier_matches, geometry.config = shuffled, UNCALIBRATED
        database.update_two_view_geometry(1, 2, geometry)
    assert read_view_graph(path).read_verdicts.tolist() == [EdgeVerdict.UNCALIBRATED] + [EdgeVerdict.KEPT] * 14


# Stored poses and matrices


def identity_and_zero(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.cam2_from_cam1 = pycolmap.Rigid3d()


def opposite_translation(geometry: pycolmap.TwoViewGeometry) -> None:
    pose = geometry.cam2_from_cam1
    geometry.cam2_from_cam1 = pycolmap.Rigid3d(pose.rotation, -pose.translation)


def inverse(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.cam2_from_cam1 = geometry.cam2_from_cam1.inverse()


def absent(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.cam2_from_cam1 = None


def negative_matrix(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.E = -geometry.E
    geometry.cam2_from_cam1 = None


def only_the_pose(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.E = geometry.F = None


def pose_beside_wrong_matrices(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.E = geometry.F = np.array([[0.1, 2.0, 0.3], [-1.0, 0.2, 0.5], [0.7, -0.4, 0.1]])


def only_fundamental(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.E = geometry.cam2_from_cam1 = None


def nothing_but_matches(geometry: pycolmap.TwoViewGeometry) -> None:
    geometry.E = geometry.F = geometry.cam2_from_cam1 = None


@pytest.mark.parametrize(
    "change",
    [
        identity_and_zero,
        opposite_translation,
        inverse,
        absent,
        negative_matrix,
        only_the_pose,
        pose_beside_wrong_matrices,
        only_fundamental,
        nothing_but_matches,
    ],
    ids=lambda change: change.__name__,
)
def test_poses_are_right_whatever_is_stored(tmp_path: Path, change: object) -> None:
    truth = make_database(tmp_path / "a.db", num_images=4, num_points=60, noise_px=0.0, stored_poses=True)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        for i, j in ((1, 2), (1, 3), (2, 4), (3, 4)):
            geometry = database.read_two_view_geometry(i, j)
            assert geometry.cam2_from_cam1 is not None
            change(geometry)
            database.update_two_view_geometry(i, j, geometry)
    graph = read_view_graph(tmp_path / "a.db")
    assert (graph.read_verdicts == EdgeVerdict.KEPT).all()
    assert max(largest_errors(graph, truth)) < 1e-6


# Scenes without depth, cameras without baseline


@pytest.mark.parametrize("config", [CALIBRATED, PANORAMIC, PLANAR_OR_PANORAMIC])
def test_cameras_at_one_place_give_rotations_only(tmp_path: Path, config: int) -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(150, 3)) + np.array([0.0, 0.0, 12.0])
    center = np.zeros(3)
    targets = np.array([[0.0, 0.0, 12.0], [1.0, 0.2, 12.0], [-0.6, -0.8, 12.0]])
    poses = [look_at(center, target) for target in targets]
    write_views(tmp_path / "a.db", poses, points, config, noise_px=0.5)
    graph = read_view_graph(tmp_path / "a.db")
    assert (graph.read_verdicts == EdgeVerdict.ROTATION_ONLY).all()
    R = np.array([poses[j].rotation.matrix() @ poses[i].rotation.matrix().T for i, j in graph.edges])
    # 0.5 px of 1280, 150 points; the turn about the axis is the least certain of the three.
    assert angle(graph.cam2_from_cam1_rotations, R).max() < np.radians(0.1)


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_a_short_baseline_keeps_its_direction(tmp_path: Path, noise_px: float) -> None:
    """A hundredth of the distance: parallax of some five pixels."""
    points = 3.0 * np.random.default_rng(5).normal(size=(300, 3)) + np.array([0.0, 0.0, 12.0])
    centers = np.array([[0.0, 0.0, 0.0], [0.12, 0.0, 0.0], [0.0, 0.12, 0.0]])
    poses = [look_at(center, np.array([0.2 * k, 0.0, 12.0])) for k, center in enumerate(centers)]
    write_views(tmp_path / "a.db", poses, points, CALIBRATED, noise_px=noise_px)
    graph = read_view_graph(tmp_path / "a.db")
    assert (graph.read_verdicts == EdgeVerdict.KEPT).all()
    for (i, j), direction in zip(graph.edges, graph.cam2_in_cam1_directions, strict=True):
        true = poses[i].rotation.matrix() @ (centers[j] - centers[i])
        assert direction @ true / np.linalg.norm(true) > np.cos(np.radians(1e-2 + 10.0 * noise_px))


def test_pairs_of_a_plane_have_the_pose_that_explains_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    points = np.column_stack([rng.uniform(-2, 2, (200, 2)), np.zeros(200)])
    centers = np.array([[-3.0, 0.5, -9.0], [0.0, -1.0, -10.0], [4.0, 0.0, -8.0]])
    poses = [look_at(c, np.array([0.1 * k, 0.0, 0.0])) for k, c in enumerate(centers)]
    camera = write_views(tmp_path / "a.db", poses, points, PLANAR)
    K = camera.calibration_matrix()
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        for i, j in ((0, 1), (0, 2), (1, 2)):
            geometry = database.read_two_view_geometry(i + 1, j + 1)
            plane = [np.column_stack([p.rotation.matrix()[:, :2], p.translation]) for p in (poses[i], poses[j])]
            geometry.H = K @ plane[1] @ np.linalg.inv(plane[0]) @ np.linalg.inv(K)
            database.update_two_view_geometry(i + 1, j + 1, geometry)
    graph = read_view_graph(tmp_path / "a.db")
    assert (graph.read_verdicts == EdgeVerdict.KEPT).all()
    assert graph.planar.all()
    for k in range(3):
        R, d = graph.cam2_from_cam1_rotations[k], graph.cam2_in_cam1_directions[k]
        rows = slice(graph.inlier_offsets[k], graph.inlier_offsets[k + 1])
        normals = np.cross(graph.inlier_bearings2[rows] @ R, d)
        assert np.abs(np.einsum("ka,ka->k", normals, graph.inlier_bearings1[rows])).max() < 1e-6
