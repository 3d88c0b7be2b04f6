"""A street in two parts without a link, taken by one camera: what is known of each reaches models and tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from linked_scenes import FOCAL, HEIGHT, WIDTH, near, projection_centers, street, write_scene
from synthetic_databases import changed_copy

from colmap_vg import (
    MappingOptions,
    PoseSolution,
    SolveOptions,
    ViewGraph,
    align_positions,
    read_view_graph,
    solve_view_graph,
)
from colmap_vg.colmap_io.reconstruction import loaded_cache, reconstruction_from_solution
from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.jobs.verdict_tables import read_tables, verdict_tables, write_tables

SIZES = (10, 7)
PARTS = (slice(0, 10), slice(10, 17))
OPTIONS = SolveOptions(covariances=True)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The camera's focal length is known."""
    path = tmp_path_factory.mktemp("parts") / "known.db"
    poses, points = street(sum(SIZES), 1)
    pairs = [(i, j) for i, j in near(sum(SIZES), 3) if (i < SIZES[0]) == (j < SIZES[0])]
    write_scene(path, poses, points, pairs, seed=1)
    return path


@pytest.fixture(scope="module")
def unknown_focal(database: Path) -> Path:
    params = np.array([1.1 * FOCAL, WIDTH / 2, HEIGHT / 2]).tobytes()
    change = ("UPDATE cameras SET prior_focal_length = 0, params = ?", (params,))
    return changed_copy(database, database.with_name("unknown.db"), change)


@pytest.fixture(scope="module")
def mapped(database: Path, tmp_path_factory: pytest.TempPathFactory) -> MappingResult:
    options = MappingOptions(solve=OPTIONS)
    return map_database(database, None, tmp_path_factory.mktemp("mapped"), options, StageLog())


def of_part_alone(graph: ViewGraph, part: slice) -> PoseSolution:
    inside = np.isin(graph.edges, np.arange(graph.num_images)[part]).all(axis=1)
    return solve_view_graph(replace(graph, read_verdicts=np.where(inside, "kept", "excluded")))


def test_a_camera_of_two_components_has_the_focal_length_of_the_larger_one(unknown_focal: Path, tmp_path: Path) -> None:
    graph = read_view_graph(unknown_focal)
    solution = solve_view_graph(graph)
    assert solution.component.tolist() == [0] * SIZES[0] + [1] * SIZES[1]
    larger, smaller = (of_part_alone(graph, part) for part in PARTS)
    assert solution.focal_scales.tolist() == larger.focal_scales.tolist() != smaller.focal_scales.tolist()
    focal = float(graph.camera_focal_lengths[0] * solution.focal_scales[0])
    assert focal == pytest.approx(FOCAL, rel=0.005)
    with loaded_cache(unknown_focal, tmp_path, 15) as (cache, _):
        models = [reconstruction_from_solution(cache, solution, graph, component) for component in (0, 1)]
    for model in models:
        assert model.num_cameras() == 1
        np.testing.assert_allclose(model.camera(1).params, [focal, WIDTH / 2, HEIGHT / 2], rtol=1e-12)


def test_each_model_of_one_camera_adjusts_it_and_the_solution_tells_the_larger_one(
    unknown_focal: Path, tmp_path: Path
) -> None:
    result = map_database(unknown_focal, None, tmp_path / "out", MappingOptions(), StageLog())
    assert [model.num_reg_images() for model in result.models.values()] == list(SIZES)
    first, second = (model.camera(1).params[0] for model in result.models.values())
    for found in (first, second):
        assert found == pytest.approx(FOCAL, rel=0.005)
    assert first != second
    told = result.graph.camera_focal_lengths * result.solution.focal_scales
    assert told == pytest.approx(first, rel=1e-12)


def errors_per_sigma(solution: PoseSolution) -> list[tuple[float, float]]:
    """Root mean square errors of each part's positions and rotations, in standard deviations."""
    poses, _ = street(sum(SIZES), 1)
    p, R = projection_centers(poses), np.array([pose.rotation.matrix() for pose in poses])
    found = []
    for part in PARTS:
        distance, similarity = align_positions(p[part], solution.projection_centers[part])
        aligned = R[part] @ similarity.rotation.T
        turn = so3.angle(solution.cam_from_world_rotations[part] @ np.swapaxes(aligned, 1, 2))
        of_position, of_rotation = (
            np.trace(covariances[part], axis1=1, axis2=2)
            for covariances in (solution.position_covariances, solution.rotation_covariances)
        )
        squares = np.mean(distance**2 / of_position), np.mean(turn**2 / of_rotation)
        found.append((float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))))
    return found


def test_covariances_of_each_component_are_in_the_unit_of_its_poses(database: Path, mapped: MappingResult) -> None:
    graph = read_view_graph(database)
    assert solve_view_graph(graph).position_covariances is None
    for solution in (solve_view_graph(graph, OPTIONS), mapped.solution):
        for position, rotation in errors_per_sigma(solution):
            assert 0.4 < position < 2.0
            assert 0.15 < rotation < 2.0  # three degrees of freedom are common to all images of a part


def test_deviations_stand_in_the_table_of_images(mapped: MappingResult, tmp_path: Path) -> None:
    graph, solution = mapped.graph, mapped.solution
    write_tables(tmp_path, verdict_tables(graph, solution))
    for row, image in enumerate(read_tables(tmp_path).images):
        p = solution.projection_centers[solution.component == solution.component[row]]
        radius = np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))
        position = np.sqrt(np.trace(solution.position_covariances[row]))
        rotation = np.sqrt(np.trace(solution.rotation_covariances[row]))
        assert float(image.position_sigma_percent) == pytest.approx(100.0 * position / radius, abs=6e-4)
        assert float(image.rotation_sigma_deg) == pytest.approx(np.degrees(rotation), abs=6e-4)
