"""Places that look alike, joined by pairs that agree with each other, against one place with few links."""

from itertools import combinations, product
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from linked_scenes import alike_streets, near, projection_centers, street, survey, write_scene
from synthetic_databases import look_at

from colmap_vg import MappingOptions, SolutionStatus
from colmap_vg.events import StageLog
from colmap_vg.jobs.bridges import all_bridges
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.mapping.weak_cuts import WeakCut, _Expected, _expected, _normals

NUM = 10


def mapped(path: Path, out: Path) -> tuple[MappingResult, list[str]]:
    log = StageLog()
    return map_database(path, None, out, MappingOptions(), log), log.warnings


@pytest.mark.parametrize("links", [1, 2, 4, 8])
@pytest.mark.parametrize("alike", [0.2, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_streets_that_look_alike_are_doubted(seed: int, alike: float, links: int, tmp_path: Path) -> None:
    poses, points, looks = alike_streets(NUM, alike, seed)
    within = [(i, j) for i, j in near(2 * NUM, 3) if (i < NUM) == (j < NUM)]
    middle = range(3, 7)
    false = [(i, NUM + j) for i, j in product(middle, middle) if abs(i - j) <= 1]
    chosen = np.random.default_rng(seed).permutation(len(false))[:links]
    write_scene(
        tmp_path / "a.db",
        poses,
        points,
        within + [false[k] for k in chosen],
        seed=seed,
        looks=looks,
        compared=combinations(range(2 * NUM), 2),
    )
    result, warnings = mapped(tmp_path / "a.db", tmp_path / "out")
    parts = [{image_id <= NUM for image_id in model.reg_image_ids()} for model in result.models.values()]
    if any(len(part) == 2 for part in parts):
        assert result.solution.status == SolutionStatus.DOUBTFUL
        marked = set(result.solution.image_ids[result.solution.in_doubt].tolist())
        assert marked in (set(range(1, NUM + 1)), set(range(NUM + 1, 2 * NUM + 1)))
        assert any("look alike" in told or "looks alike" in told for told in warnings)
        assert any(not bridge.firm for bridge in all_bridges(result.graph, result.solution, result.weak_cuts))


@pytest.mark.parametrize("links", [1, 2, 3])
@pytest.mark.parametrize("all_compared", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_one_street_with_few_links_is_not(seed: int, all_compared: bool, links: int, tmp_path: Path) -> None:
    poses, points = street(2 * NUM, seed)
    pairs = [(i, j) for i, j in near(2 * NUM, 3) if (i < NUM) == (j < NUM)] + [(9, 10), (8, 10), (9, 11)][:links]
    # Of what is further apart nothing was found, rightly.
    apart = [(i, j) for i, j in combinations(range(2 * NUM), 2) if j - i > 4] if all_compared else []
    write_scene(tmp_path / "a.db", poses, points, pairs, seed=seed, compared=apart)
    result, warnings = mapped(tmp_path / "a.db", tmp_path / "out")
    assert result.solution.status == SolutionStatus.SOLVED
    assert not warnings
    (bridge,) = (b for b in all_bridges(result.graph, result.solution, result.weak_cuts) if b.num_images == NUM)
    assert bridge.num_pairs == links
    assert bridge.firm
    assert "that both should see" in bridge.told


def test_pairs_that_nobody_compared_are_not_missed(tmp_path: Path) -> None:
    poses, points = survey(7, 6)
    places = projection_centers(poses)
    close = np.linalg.norm(places[:, None] - places[None], axis=2) < 2.3
    pairs = [(i, j) for i, j in combinations(range(42), 2) if close[i, j] and (i < 21) == (j < 21)] + [(17, 24)]
    write_scene(tmp_path / "a.db", poses, points, pairs)
    result, warnings = mapped(tmp_path / "a.db", tmp_path / "out")
    assert result.solution.status == SolutionStatus.SOLVED
    assert not warnings


def test_few_expected_observations_contradict_only_by_a_standard_deviation() -> None:
    def cut(expected: int, seen: int) -> WeakCut:
        return WeakCut(frozenset({1, 2, 3}), 5, 500, expected, seen, 0.64)

    assert not cut(29, 0).contradicted  # too few to tell
    assert not cut(45, 18).contradicted  # 0.40, where 0.416 +- 0.07 is the bound
    assert cut(45, 14).contradicted
    assert cut(4500, 1750).contradicted


def test_normals_are_those_of_walls_and_none_of_clouds() -> None:
    rng = np.random.default_rng(0)
    wall = np.stack([rng.uniform(0, 4, 600), rng.normal(0, 0.01, 600), rng.uniform(0, 3, 600)], axis=1)
    side = wall[:, [1, 0, 2]] + [8.0, 1.0, 0.0]
    cloud = rng.uniform([0.0, 20.0, 0.0], [3.0, 23.0, 3.0], (600, 3))
    every = np.concatenate([wall, side, cloud])
    for points, axis in ((wall[:50], 1), (side[:50], 0)):
        normals, flat = _normals(every, points)
        assert flat.mean() > 0.95
        assert np.abs(normals[flat, axis]).min() > 0.98
    assert _normals(every, cloud[:200])[1].mean() < 0.1


def expected_observations(points: np.ndarray, centers: np.ndarray) -> _Expected:
    """Expected observations of points that the first three of some images see, all of which look at the origin."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=800, height=800, params=[800.0, 800.0, 400.0, 400.0])
    camera.camera_id = 1
    reconstruction.add_camera_with_trivial_rig(camera)
    for number, center in enumerate(centers, 1):
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
        cam_from_world = look_at(center, np.zeros(3))
        if number <= 3:
            image.points2D = [pycolmap.Point2D(np.asarray(camera.img_from_cam(cam_from_world * p))) for p in points]
        reconstruction.add_image_with_trivial_frame(image, cam_from_world)
    for row, xyz in enumerate(points):
        track = pycolmap.Track()
        for number in (1, 2, 3):
            track.add_element(number, row)
        reconstruction.add_point3D(xyz, track)
    image_ids = np.arange(1, len(centers) + 1)
    return _expected(reconstruction, image_ids, np.array(list(combinations(image_ids.tolist(), 2)), dtype=np.int64))


def test_walls_are_expected_only_where_they_look_alike() -> None:
    """Three images see a wall at 60 degrees; one at 52 should see it, too, and one at 72 sees it far more slanted."""
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(-0.5, 0.5, 300), rng.normal(0, 0.002, 300), rng.uniform(-0.5, 0.5, 300)], axis=1)
    angles = np.radians([59.5, 60.0, 60.5, 52.0, 72.0])
    expected = expected_observations(wall, 6.0 * np.stack([np.sin(angles), np.cos(angles), 0.0 * angles], axis=1))
    assert np.sum(expected.images == 3) > 500  # of 300 points beside three images
    assert not np.any(expected.images == 4)


def test_clouds_are_expected_only_from_alike_angles_and_distances() -> None:
    """Three images see a cloud; one 8 degrees off should, too, those 20 degrees off or half as far again should not."""
    cloud = np.random.default_rng(2).uniform(-0.5, 0.5, (300, 3))
    angles, distances = np.radians([-0.5, 0.0, 0.5, 8.0, 20.0, 0.0]), np.array([6.0, 6.0, 6.0, 6.0, 6.0, 9.0])
    directions = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    expected = expected_observations(cloud, distances[:, None] * directions)
    of_images = np.bincount(expected.images, minlength=6)
    assert (of_images[:4] > 300).all()
    assert (of_images[4:] == 0).all()
    assert expected.seen[expected.images < 3].all()
    assert not expected.seen[expected.images == 3].any()
