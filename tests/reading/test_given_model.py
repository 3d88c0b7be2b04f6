"""Reading beside a given model: pairs that it explains get its poses, all others are read as without it."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_vg import ReadOptions, ViewGraph
from colmap_vg.geometry import so3
from colmap_vg.reading.read import read_with_caveats
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import SyntheticViews, synthetic_views
from colmap_vg.solver.agreement import pair_agreement

VIEWS = synthetic_views("drone", 16, noise_px=0.5)
NEW = (2, 9)
"""Rows of the images that the model lacks."""


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("given") / "database.db"
    write_synthetic_database(path, VIEWS)
    return path


def model_of(views: SyntheticViews, database: Path, wrong: tuple[int, ...] = ()) -> pycolmap.Reconstruction:
    """The true cameras of all images but the new ones; those of wrong rows are turned by 20 degrees."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(shutil.copy(database, database.with_name("copy.db"))) as opened:
        images, camera = opened.read_all_images(), opened.read_all_cameras()[0]
    model.add_camera_with_trivial_rig(camera)
    for row, image in enumerate(sorted(images, key=lambda image: image.image_id)):
        if row in NEW:
            continue
        R = views.cam_from_world_rotations[row]
        if row in wrong:
            R = so3.exp(np.array([0.0, np.radians(20.0), 0.0])) @ R
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ views.projection_centers[row])
        # Ids differ from those of the database: names are what counts.
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=image.name, camera_id=camera.camera_id, image_id=100 + row), pose
        )
    return model


def is_given(graph: ViewGraph) -> np.ndarray:
    """Pairs of two given images, but for the simulated false ones."""
    return ~np.isin(graph.edges, NEW).any(axis=1) & ~is_false(graph)


def is_false(graph: ViewGraph) -> np.ndarray:
    wrong = {tuple(pair) for pair in VIEWS.pairs[VIEWS.wrong].tolist()}
    return np.array([tuple(pair) in wrong for pair in graph.edges.tolist()])


def apart(one: ViewGraph, other: ViewGraph) -> np.ndarray:
    """Angles (m,) between the relative rotations of two graphs, radians."""
    return so3.angle(one.cam2_from_cam1_rotations @ np.swapaxes(other.cam2_from_cam1_rotations, 1, 2))


def test_pairs_of_the_model_have_its_poses_and_others_their_own(database: Path) -> None:
    graph, caveats = read_with_caveats(database, ReadOptions(), model_of(VIEWS, database))
    plain, _ = read_with_caveats(database, ReadOptions())
    assert caveats == ()
    np.testing.assert_array_equal(graph.edges, plain.edges)
    np.testing.assert_array_equal(graph.num_inliers, plain.num_inliers)
    given, i, j = is_given(graph), *graph.edges.T
    R, centers = VIEWS.cam_from_world_rotations, VIEWS.projection_centers
    assert 0 < given.sum() < len(given)
    np.testing.assert_allclose(
        graph.cam2_from_cam1_rotations[given], (R[j] @ np.swapaxes(R[i], 1, 2))[given], atol=1e-12
    )
    directions = np.einsum("kab,kb->ka", R[i], centers[j] - centers[i])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(graph.cam2_in_cam1_directions[given], directions[given], atol=1e-12)
    assert (graph.read_verdicts[given] == "kept").all()
    # Their own poses are not refined: they only check those of added images.
    assert np.degrees(apart(graph, plain)[~given]).max() < 1.0
    cosine = np.sum(graph.cam2_in_cam1_directions * plain.cam2_in_cam1_directions, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine[~given], -1.0, 1.0))).max() < 5.0
    assert (np.diff(graph.inlier_offsets)[given] == 0).all()
    k = int(np.flatnonzero(~given)[-1])
    rows, of_plain = (slice(*g.inlier_offsets[k : k + 2]) for g in (graph, plain))
    np.testing.assert_array_equal(graph.inlier_bearings2[rows], plain.inlier_bearings2[of_plain])


def test_pairs_that_contradict_the_model_are_estimated_and_count_against_it(database: Path) -> None:
    wrong = 5
    model = model_of(VIEWS, database, (wrong,))
    graph, _ = read_with_caveats(database, ReadOptions(), model)
    plain, _ = read_with_caveats(database, ReadOptions())
    of_wrong = (graph.edges == wrong).any(axis=1) | is_false(graph)
    assert np.degrees(apart(graph, plain)[of_wrong]).max() < 1.0
    R, centers = VIEWS.cam_from_world_rotations.copy(), VIEWS.projection_centers
    R[wrong] = so3.exp(np.array([0.0, np.radians(20.0), 0.0])) @ R[wrong]
    agreement = pair_agreement(graph, R, centers, np.zeros(len(R), dtype=np.int64))[0]
    assert agreement.pairs == pytest.approx(1.0 - of_wrong.mean(), abs=0.01)


def test_lists_of_pairs_are_obeyed(database: Path, tmp_path: Path) -> None:
    plain, _ = read_with_caveats(database, ReadOptions())
    given = np.flatnonzero(is_given(plain))[0]
    names = [plain.image_names[row] for row in plain.edges[given]]
    (tmp_path / "excluded.txt").write_text(" ".join(names) + "\n")
    options = ReadOptions(excluded_pairs_path=tmp_path / "excluded.txt")
    graph, _ = read_with_caveats(database, options, model_of(VIEWS, database))
    assert graph.read_verdicts[given] == "excluded"
    assert (graph.read_verdicts == "excluded").sum() == 1


@pytest.mark.parametrize("prior", [0, 1])
def test_calibrations_are_those_of_the_model(database: Path, tmp_path: Path, prior: int) -> None:
    """Whatever the database says of them, and whether or not it claims to know."""
    model = model_of(VIEWS, database)
    wrong = tmp_path / "wrong.db"
    shutil.copyfile(database, wrong)
    camera = next(iter(model.cameras.values()))
    params = camera.params.copy()
    params[0] *= 1.3
    with closing(sqlite3.connect(wrong)) as connection, connection:
        connection.execute("UPDATE cameras SET params = ?, prior_focal_length = ?", (params.tobytes(), prior))
    graph, caveats = read_with_caveats(wrong, ReadOptions(), model)
    assert caveats == ()
    assert graph.camera_focal_lengths[0] == pytest.approx(camera.mean_focal_length())
    assert graph.camera_focal_known.all()
    plain, _ = read_with_caveats(database, ReadOptions(trust_focal_lengths="always"))
    np.testing.assert_allclose(graph.cam2_from_cam1_rotations, plain.cam2_from_cam1_rotations, atol=0.03)


def test_pairs_with_few_matches_are_not_used_even_if_they_agree(database: Path) -> None:
    plain, _ = read_with_caveats(database, ReadOptions())
    least = int(np.median(plain.num_inliers))
    graph, _ = read_with_caveats(database, ReadOptions(min_num_inliers=least), model_of(VIEWS, database))
    few = graph.num_inliers < least
    assert (is_given(graph) & few).any()
    assert (graph.read_verdicts[few] == "few_inliers").all()
