"""Solutions written into reconstructions: the database's ids, names and cameras, the solution's poses and focals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import make_database, sha256, with_other_ids

from colmap_vg.colmap_io.reconstruction import (
    _file_sizes,
    loaded_cache,
    reconstruction_from_solution,
    write_model,
)
from colmap_vg.errors import DatabaseError
from colmap_vg.reading.read import read_view_graph
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.solve import solve_view_graph

RADIAL = ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05))


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ViewGraph, PoseSolution]:
    folder = tmp_path_factory.mktemp("solved")
    make_database(folder / "a.db", num_images=5, num_points=60, noise_px=0.3, camera=RADIAL, camera_per_image=True)
    path = with_other_ids(folder / "a.db", folder / "database.db")
    graph = read_view_graph(path)
    return path, graph, solve_view_graph(graph)


def test_the_poses_are_the_solutions(solved: tuple[Path, ViewGraph, PoseSolution], tmp_path: Path) -> None:
    path, graph, solution = solved
    before = sha256(path)
    with loaded_cache(path, tmp_path, 15) as (cache, _):
        model = reconstruction_from_solution(cache, solution, graph)
    assert sha256(path) == before
    assert list(tmp_path.iterdir()) == []
    assert sorted(model.reg_image_ids()) == graph.image_ids.tolist()
    for row, image_id in enumerate(graph.image_ids.tolist()):
        image = model.image(image_id)
        assert image.name == graph.image_names[row]
        assert image.camera_id == graph.camera_ids[graph.camera_idx[row]]
        assert np.allclose(image.cam_from_world().rotation.matrix(), solution.cam_from_world_rotations[row], atol=1e-12)
        assert np.allclose(image.projection_center(), solution.projection_centers[row], atol=1e-12)
        assert image.num_points2D() == 70  # 60 points of the scene and 10 that match nothing


def test_images_that_are_not_registered_have_no_pose(
    solved: tuple[Path, ViewGraph, PoseSolution], tmp_path: Path
) -> None:
    path, graph, solution = solved
    component = np.array([0, 1, 0, 0, -1])
    with loaded_cache(path, tmp_path, 15) as (cache, _):
        model = reconstruction_from_solution(cache, replace(solution, component=component), graph)
    assert sorted(model.reg_image_ids()) == [1003, 1009, 1012]
    assert model.num_images() == 5
    for image_id in (1006, 1015):
        assert not model.image(image_id).has_pose
        assert model.image(image_id).num_points2D() == 70


def test_focal_factors_scale_the_cameras_and_one_changes_no_bit(
    solved: tuple[Path, ViewGraph, PoseSolution], tmp_path: Path
) -> None:
    path, graph, solution = solved
    scales = np.array([1.0, 1.1, 1.0, 1.0, 0.9])
    with loaded_cache(path, tmp_path, 15) as (cache, _):
        model = reconstruction_from_solution(cache, replace(solution, focal_scales=scales), graph)
    for camera_id in (51, 53, 54):
        assert model.camera(camera_id).params.tolist() == list(RADIAL[1])
    # The distortion that is seen in the image stays: k grows with the square of the factor.
    assert np.allclose(model.camera(52).params, [1408.0, 512.0, 384.0, 0.05 * 1.21], rtol=1e-12)
    assert np.allclose(model.camera(55).params, [1152.0, 512.0, 384.0, 0.05 * 0.81], rtol=1e-12)


def test_the_working_copy_goes_even_after_an_error(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("no database " * 100)
    (tmp_path / "work").mkdir()
    with pytest.raises(DatabaseError, match=r"text\.db"), loaded_cache(tmp_path / "text.db", tmp_path / "work", 15):
        pass
    assert list((tmp_path / "work").iterdir()) == []


def test_the_sizes_of_written_files_are_known(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=5, num_points3D=40))
    write_model(model, tmp_path)
    sizes = _file_sizes(model)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / name).stat().st_size == sizes[name]
    for name, size in sizes.items():
        assert (tmp_path / name).stat().st_size >= size
