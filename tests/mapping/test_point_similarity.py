"""The similarity between two models against a known one, among wrong points."""

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import Similarity
from colmap_vg.mapping.join import is_spread
from colmap_vg.mapping.point_similarity import SeenPoints, similarity_of_points

TRUE = Similarity(2.5, so3.exp(np.array([[0.3, -1.2, 0.7]]))[0], np.array([4.0, -1.0, 2.0]))


def seen(points: np.ndarray, rotation: np.ndarray, center: np.ndarray, noise_px: float, seed: int) -> SeenPoints:
    """Points in front of one camera, with keypoints of the points as they are."""
    k, f = len(points), 1000.0
    local = (points - center) @ rotation.T
    noise = noise_px / f * np.random.default_rng(seed).standard_normal((k, 2))
    rays = normalized(np.column_stack([local[:, :2] / local[:, 2:] + noise, np.ones(k)]))
    return SeenPoints(points, np.tile(rotation, (k, 1, 1)), np.tile(center, (k, 1)), rays, np.full(k, f))


def two_models(num_points: int, num_wrong: int, noise_px: float, seed: int = 0) -> tuple[SeenPoints, SeenPoints]:
    rng = np.random.default_rng(seed)
    other = rng.uniform([-2, -2, 4], [2, 2, 8], (num_points, 3))
    own = TRUE.apply(other)
    own[:num_wrong] = own[rng.permutation(num_wrong + 1)[1:]][:num_wrong] + 1.5 * rng.standard_normal((num_wrong, 3))
    # The first model's camera stands where the second model's origin comes to lie.
    return (
        seen(own, TRUE.rotation.T, TRUE.translation, noise_px, 1),
        seen(other, np.eye(3), np.zeros(3), noise_px, 2),
    )


@pytest.mark.parametrize("num_wrong", [0, 30, 60])
def test_the_similarity_is_found_among_wrong_points(num_wrong: int) -> None:
    found, agree = similarity_of_points(*two_models(100, num_wrong, 0.5))
    assert found is not None
    assert found.scale == pytest.approx(TRUE.scale, rel=0.01)
    assert so3.angle((found.rotation @ TRUE.rotation.T)[None])[0] < 0.01
    assert np.linalg.norm(found.translation - TRUE.translation) < 0.05
    assert agree[num_wrong:].all()
    assert agree[:num_wrong].mean() < 0.1 if num_wrong else True


def test_points_that_nothing_joins_agree_by_threes_at_most() -> None:
    own, _ = two_models(60, 0, 0.5)
    _, other = two_models(60, 0, 0.5, seed=7)
    assert similarity_of_points(own, other)[1].sum() < 8


def test_fewer_than_three_points_tell_nothing() -> None:
    own, other = two_models(2, 0, 0.0)
    found, agree = similarity_of_points(own, other)
    assert found is None
    assert not agree.any()


def test_points_along_a_line_do_not_join() -> None:
    points = np.random.default_rng(0).standard_normal((50, 3))
    assert is_spread(points)
    assert is_spread(points * [1.0, 1.0, 0.0])
    assert not is_spread(points * [1.0, 0.01, 0.01])
