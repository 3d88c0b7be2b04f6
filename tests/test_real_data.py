"""Photographs with known cameras: models from their databases, held against the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import colmap_vg
from colmap_vg import (
    SolutionStatus,
    SolveOptions,
    ViewGraph,
    align_positions,
    read_view_graph,
    solve_view_graph,
    view_graph_mapping,
)
from colmap_vg.geometry import so3
from colmap_vg.mapping.support import supported_observations
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors
from colmap_vg.two_view.segments import segment_quantiles

pytestmark = pytest.mark.real_data

GLOBAL_MAPPING_MM = {"fountain-p11": 2.95, "herz-jesus-p25": 5.76, "temple": 1.10, "castle-p19": 28.7}
"""Mean position errors of pycolmap.global_mapping 4.2.1 on these databases."""


def true_centers(folder: Path) -> dict[str, np.ndarray]:
    rows = [line.split() for line in (folder / "ground_truth.txt").read_text().splitlines() if line.strip()]
    return {row[0]: np.array(row[-3:], dtype=float) for row in rows if row[0] != "#"}


def errors_mm(names: list[str], centers: np.ndarray, truth: dict[str, np.ndarray]) -> np.ndarray:
    errors, _ = align_positions(centers, np.array([truth[name] for name in names]))
    return 1e3 * errors


@pytest.mark.parametrize("name", GLOBAL_MAPPING_MM)
def test_models_are_as_accurate_as_those_of_global_mapping(name: str, data_folder: Path, tmp_path: Path) -> None:
    folder = data_folder / "images" / name
    before = (folder / "database.db").read_bytes()
    models = view_graph_mapping(folder / "database.db", None, tmp_path / "out")
    truth = true_centers(folder)
    images = [models[0].image(i) for i in sorted(models[0].reg_image_ids())]
    assert len(images) == len(truth)
    centers = np.array([image.projection_center() for image in images])
    errors = errors_mm([image.name for image in images], centers, truth)
    assert errors.mean() <= 1.05 * GLOBAL_MAPPING_MM[name]
    assert models[0].compute_mean_reprojection_error() < 1.0
    assert (folder / "database.db").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "bound_mm"), [("fountain-p11", 2.7), ("herz-jesus-p25", 6.5), ("temple", 3.0), ("castle-p19", 100.0)]
)
def test_the_graph_alone_is_already_close(name: str, bound_mm: float, data_folder: Path) -> None:
    folder = data_folder / "images" / name
    graph = read_view_graph(folder / "database.db")
    solution = solve_view_graph(graph)
    assert solution.registered.all()
    assert errors_mm(list(graph.image_names), solution.projection_centers, true_centers(folder)).mean() <= bound_mm


@pytest.mark.parametrize(("name", "fewest"), [("lund", 25), ("banana", 15), ("sceaux", 11)])
def test_no_image_is_registered_that_few_points_fix(name: str, fewest: int, data_folder: Path, tmp_path: Path) -> None:
    model = view_graph_mapping(data_folder / "images" / name / "database.db", None, tmp_path / "out")[0]
    support = supported_observations(model, min_angle_deg=1.5)
    assert len(support) >= fewest
    assert min(support.values()) >= 15


def with_images_in_another_order(graph: ViewGraph, order: np.ndarray) -> ViewGraph:
    """The graph with its images, and by them its edges, in another order."""
    place = np.argsort(order)
    assert graph.camera_idx is not None
    return replace(
        graph,
        image_ids=graph.image_ids[order],
        image_names=tuple(graph.image_names[i] for i in order),
        camera_idx=graph.camera_idx[order],
        edges=place[graph.edges],
    )


def test_an_object_half_of_whose_pairs_are_false(data_folder: Path) -> None:
    # Averaging folded this set, whatever the weights of its edges but unit ones.
    folder = data_folder / "databases" / "fox"
    rows = [line.split() for line in (folder / "reference_positions.txt").read_text().splitlines() if line[0] != "#"]
    truth = {row[0]: np.array(row[1:], dtype=float) for row in rows}
    graph = read_view_graph(folder / "database.db")
    cases = [(graph, seed) for seed in range(3)]
    cases.append((with_images_in_another_order(graph, np.random.default_rng(0).permutation(graph.num_images)), 0))
    for shuffled, seed in cases:
        solution = solve_view_graph(shuffled, SolveOptions(random_seed=seed))
        assert solution.status == SolutionStatus.SOLVED
        assert solution.registered.all()
        reference = np.array([truth[name] for name in shuffled.image_names])
        errors, _ = align_positions(solution.projection_centers, reference)
        spread = np.sqrt(np.mean(np.sum((reference - reference.mean(axis=0)) ** 2, axis=1)))
        assert np.median(errors) <= 0.006 * spread
        assert solution.agreement[0].inliers >= 0.87


@pytest.mark.parametrize("name", [*GLOBAL_MAPPING_MM, "lund", "banana", "sceaux"])
def test_photographs_with_few_false_pairs_are_not_doubted(name: str, data_folder: Path) -> None:
    solution = solve_view_graph(read_view_graph(data_folder / "images" / name / "database.db"))
    assert solution.status in (SolutionStatus.SOLVED, SolutionStatus.PARTIAL)
    assert solution.agreement[0].inliers > 0.98


def test_stored_poses_that_nobody_recovered_are_not_used(data_folder: Path) -> None:
    # Every pair of this database stores the identity and a zero translation.
    path = data_folder / "databases" / "untrusted_relative_poses.db"
    before = path.read_bytes()
    graph = read_view_graph(path)
    assert path.read_bytes() == before
    assert graph.num_images == 30
    used = np.flatnonzero(graph.has_direction)
    assert len(used) > 100
    assert np.median(so3.angle(graph.cam2_from_cam1_rotations[used])) > np.radians(1)
    E = essential_from_pose(graph.cam2_from_cam1_rotations, graph.cam2_in_cam1_directions)
    errors = sampson_errors(E, graph.inlier_offsets, graph.inlier_bearings1, graph.inlier_bearings2)
    medians = segment_quantiles(graph.inlier_offsets, np.abs(errors))[used]
    focals = graph.camera_focal_lengths[graph.camera_idx[graph.edges[used]]]
    assert (medians * np.sqrt(focals.prod(axis=1)) <= 4.0).all()


def test_the_model_on_disk_is_the_model_returned(data_folder: Path, tmp_path: Path) -> None:
    database = data_folder / "images" / "fountain-p11" / "database.db"
    returned = colmap_vg.view_graph_mapping(database, None, tmp_path / "out")[0]
    written = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert written.num_points3D() == returned.num_points3D()
    for image_id in returned.reg_image_ids():
        assert written.image(image_id).name == returned.image(image_id).name
        np.testing.assert_array_equal(
            written.image(image_id).cam_from_world().matrix(), returned.image(image_id).cam_from_world().matrix()
        )
