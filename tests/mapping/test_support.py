"""Counts of supported observations against a twin that looks at every pair of rays."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest
from synthetic_databases import PINHOLE

from colmap_vg.mapping.support import is_supported, supported_observations


def brute_force(model: pycolmap.Reconstruction, min_angle_deg: float, min_track_length: int) -> dict[int, int]:
    counts = dict.fromkeys(model.reg_image_ids(), 0)
    for point in model.points3D.values():
        images = [e.image_id for e in point.track.elements]
        rays = {i: model.image(i).projection_center() - point.xyz for i in images}
        widest = max(
            np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))
            for a, b in combinations(rays.values(), 2)
        )
        if len(images) >= min_track_length and widest >= min_angle_deg:
            for image_id in images:
                counts[image_id] += 1
    return counts


def make_model(num_images: int, num_points: int, track_length: int, seed: int) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(seed)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1,
            num_frames_per_rig=num_images,
            num_points3D=num_points,
            track_length=track_length,
            camera_model_id=pycolmap.CameraModelId.SIMPLE_PINHOLE,
            camera_params=list(PINHOLE[1]),
        )
    )


@pytest.mark.parametrize("track_length", [2, 3, 5])
@pytest.mark.parametrize("min_angle_deg", [0.0, 1.5])
def test_counts_are_those_of_all_pairs_of_rays(track_length: int, min_angle_deg: float) -> None:
    model = make_model(9, 80, track_length, seed=track_length)
    assert supported_observations(model, min_angle_deg) == brute_force(model, min_angle_deg, 3)
    assert supported_observations(model, min_angle_deg, 2) == brute_force(model, min_angle_deg, 2)


def test_images_of_some_frames_alone_are_counted() -> None:
    model = make_model(9, 80, 4, seed=3)
    frames = frozenset(model.image(i).frame_id for i in (2, 3, 7))
    expected = {i: count for i, count in brute_force(model, 1.5, 3).items() if i not in (2, 3, 7)}
    assert supported_observations(model, 1.5, without_frames=frames) == expected
    every = frozenset(model.reg_frame_ids())
    assert supported_observations(model, 1.5, without_frames=every) == {}


def test_a_sample_tells_what_has_support() -> None:
    model, angle = make_model(9, 80, 4, seed=3), 1.5
    counts = supported_observations(model, angle)
    for image_id, count in counts.items():
        assert is_supported(model, image_id, angle, count)
        assert not is_supported(model, image_id, angle, count + 1)
        assert not is_supported(model, image_id, 179.0, 1)
    assert min(counts.values()) > 10
    assert not is_supported(model, 1, angle, counts[1], num_asked=counts[1] - 1)
    assert not any(is_supported(make_model(9, 80, 2, seed=2), image_id, angle, 1) for image_id in range(1, 10))


def test_a_far_point_does_not_count() -> None:
    model = make_model(4, 30, -1, seed=1)
    before = supported_observations(model, 1.5)
    assert before == dict.fromkeys(range(1, 5), 30)
    for point_id in sorted(model.points3D)[:10]:
        point = model.point3D(point_id)
        point.xyz = point.xyz + np.array([0.0, 0.0, 5000.0])
    assert supported_observations(model, 1.5) == dict.fromkeys(range(1, 5), 20) == brute_force(model, 1.5, 3)


@pytest.mark.parametrize("seed", range(5))
def test_the_quick_angle_is_between_half_of_the_widest_and_the_widest(seed: int) -> None:
    model = make_model(8, 60, 4, seed)
    for min_angle_deg in (20.0, 60.0, 100.0):
        quick = supported_observations(model, min_angle_deg)
        most, least = brute_force(model, min_angle_deg, 3), brute_force(model, 2 * min_angle_deg, 3)
        assert all(least[i] <= quick[i] <= most[i] for i in quick)


def test_the_widest_angle_is_found_from_the_middle_of_a_row() -> None:
    """Three cameras in a row: from the one in the middle only half of the widest angle is seen."""
    model = make_model(3, 20, -1, seed=1)
    for image_id, x in ((1, 0.0), (2, -1.0), (3, 1.0)):
        model.image(image_id).frame.set_cam_from_world(1, pycolmap.Rigid3d(pycolmap.Rotation3d(), [-x, 0.0, 0.0]))
    for point in model.points3D.values():
        point.xyz = np.array([0.0, 0.0, 10.0])  # 5.7 degrees on each side
    assert supported_observations(model, 10.0) == dict.fromkeys(range(1, 4), 20)
    assert supported_observations(model, 12.0) == dict.fromkeys(range(1, 4), 0)


def test_a_model_without_points_supports_nobody() -> None:
    model = make_model(4, 10, -1, seed=1)
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    assert supported_observations(model, 1.5) == dict.fromkeys(range(1, 5), 0)
