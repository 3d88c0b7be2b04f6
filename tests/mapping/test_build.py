"""The steps of building a model: colours, and the options that reach pycolmap."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import make_database

from colmap_vg.mapping.build import extract_colors
from colmap_vg.mapping.options import bundle_options, mapper_options, triangulator_options
from colmap_vg.options import MappingOptions
from colmap_vg.stages import StageLog

COLOR = (200, 100, 50)


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    truth = make_database(tmp_path / "database.db", num_images=4, num_points=30)
    for point in truth.points3D.values():
        point.color = np.zeros(3, dtype=np.uint8)
    return truth


def paint(folder: Path, names: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        pixels = np.broadcast_to(np.array(COLOR, dtype=np.uint8), (768, 1024, 3))
        pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)).write(folder / name)
    return folder


def test_points_take_the_colours_of_their_photographs(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    log = StageLog()
    folder = paint(tmp_path / "images", [image.name for image in model.images.values()])
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    assert log.warnings == []


def test_missing_photographs_are_named_and_the_others_used(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    log = StageLog()
    names = sorted(image.name for image in model.images.values())
    folder = paint(tmp_path / "images", names[2:])
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    assert len(log.warnings) == 1
    assert log.warnings[0].startswith(f"2 of 4 registered images are not in {folder} (first: {names[0]})")


def test_a_photograph_that_cannot_be_read_costs_its_colours_only(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    log = StageLog()
    names = sorted(image.name for image in model.images.values())
    folder = paint(tmp_path / "images", names[1:])
    (folder / names[0]).write_bytes(b"\x89PNG\r\n\x1a\n but cut off")
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}


def test_without_a_folder_nothing_is_asked_or_said(model: pycolmap.Reconstruction) -> None:
    log = StageLog()
    extract_colors(model, None, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {(0, 0, 0)}
    assert log.warnings == []


@pytest.mark.parametrize("switch", [True, False])
def test_switches_threads_and_seed_reach_pycolmap(switch: bool) -> None:
    options = MappingOptions(
        ba_refine_focal_length=switch,
        ba_refine_principal_point=not switch,
        ba_refine_extra_params=switch,
        num_threads=3,
        random_seed=7,
    )
    bundle = bundle_options(options, loss_scale_px=0.7, max_num_iterations=11, function_tolerance=1e-4)
    assert (bundle.refine_focal_length, bundle.refine_principal_point) == (switch, not switch)
    assert bundle.refine_extra_params == switch
    assert bundle.min_track_length == 3
    assert not bundle.print_summary
    assert bundle.ceres.loss_function_type == pycolmap.LossFunctionType.CAUCHY
    assert bundle.ceres.loss_function_scale == 0.7
    solver = bundle.ceres.solver_options
    assert (solver.max_num_iterations, solver.function_tolerance, solver.num_threads) == (11, 1e-4, 3)
    mapper = mapper_options(options)
    assert (mapper.abs_pose_refine_focal_length, mapper.abs_pose_refine_extra_params) == (switch, switch)
    assert (mapper.num_threads, mapper.random_seed) == (3, 7)
    assert triangulator_options(options).random_seed == 7
