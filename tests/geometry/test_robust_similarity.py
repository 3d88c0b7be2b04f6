"""Robust alignment: as exact as least squares of the right positions, and wrong ones named."""

import numpy as np
import pytest

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.robust_similarity import align_robustly
from colmap_vg.geometry.similarity import align_positions


def scene(n: int, noise: float, wrong: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Estimated, measured and true positions, and the rows that are measured wrong by a hundred units."""
    rng = np.random.default_rng(seed)
    estimated = rng.normal(size=(n, 3)) * [1.0, 1.0, 0.2] + [4.0, 5.0, 6.0]
    truth = 30.0 * estimated @ so3.random(1, rng)[0].T + [100.0, -200.0, 50.0]
    measured = truth + noise * rng.normal(size=(n, 3))
    rows = np.sort(rng.permutation(n)[:wrong])
    directions = rng.normal(size=(wrong, 3))
    measured[rows] += 100.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return estimated, measured, truth, rows


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("n", "wrong"), [(8, 1), (20, 4), (60, 24), (200, 80)])
def test_wrong_positions_are_found_and_the_others_fitted_by_least_squares(n: int, wrong: int, seed: int) -> None:
    estimated, measured, truth, rows = scene(n, 1.0, wrong, seed)
    found = align_robustly(estimated, measured)
    assert np.flatnonzero(~found.right).tolist() == rows.tolist()
    _, oracle = align_positions(estimated[found.right], measured[found.right])
    best = np.linalg.norm(oracle.apply(estimated) - truth, axis=1).mean()
    assert np.linalg.norm(found.similarity.apply(estimated) - truth, axis=1).mean() <= 1.1 * best + 0.05
    np.testing.assert_allclose(found.residuals, measured - found.similarity.apply(estimated), atol=1e-9)


def test_without_noise_it_is_exact() -> None:
    estimated, measured, truth, rows = scene(12, 0.0, 3, 0)
    found = align_robustly(estimated, measured)
    assert np.flatnonzero(~found.right).tolist() == rows.tolist()
    np.testing.assert_allclose(found.similarity.apply(estimated), truth, atol=1e-7)


def test_standard_deviations_are_estimated_along_and_across() -> None:
    rng = np.random.default_rng(3)
    estimated = rng.normal(size=(600, 3))
    measured = 100.0 * estimated + rng.normal(size=(600, 3)) * [2.0, 2.0, 6.0]
    sigmas = np.sqrt(np.diagonal(align_robustly(estimated, measured).covariances[0]))
    np.testing.assert_allclose(sigmas, [2.0, 2.0, 6.0], rtol=0.08)


def test_given_covariances_weigh_the_positions() -> None:
    errors = []
    for seed in range(20):
        estimated, _, truth, _ = scene(20, 0.0, 0, seed)
        rng = np.random.default_rng(seed)
        sigma = np.where(np.arange(20) < 10, 0.1, 5.0)
        measured = truth + sigma[:, None] * rng.normal(size=(20, 3))
        covariances = np.square(sigma)[:, None, None] * np.eye(3)
        found = [align_robustly(estimated, measured, known).similarity for known in (covariances, None)]
        errors.append([np.linalg.norm(each.apply(estimated) - truth, axis=1).mean() for each in found])
    weighted, unweighted = np.mean(errors, axis=0)
    assert weighted < 0.2 * unweighted


def test_covariances_that_promise_too_much_are_enlarged() -> None:
    estimated, measured, _, _ = scene(100, 1.0, 0, 0)
    found = align_robustly(estimated, measured, np.broadcast_to(0.01 * np.eye(3), (100, 3, 3)))
    np.testing.assert_allclose(found.covariances[0], np.eye(3), atol=0.2)
    assert found.right.all()
    modest = align_robustly(estimated, measured, np.broadcast_to(9.0 * np.eye(3), (100, 3, 3)))
    np.testing.assert_allclose(modest.covariances[0], 9.0 * np.eye(3))


def test_a_line_leaves_the_rotation_about_it_free() -> None:
    rng = np.random.default_rng(0)
    estimated = np.outer(np.linspace(0, 1, 30), [1.0, 2.0, 3.0])
    found = align_robustly(estimated, 100.0 * estimated + rng.normal(size=(30, 3)))
    assert found.roll_is_free
    assert found.scale_uncertainty < 0.01
    assert not align_robustly(*scene(30, 1.0, 0, 0)[:2]).roll_is_free


def test_pure_noise_does_not_determine_the_scale() -> None:
    rng = np.random.default_rng(0)
    found = align_robustly(rng.normal(size=(50, 3)), rng.normal(size=(50, 3)))
    assert found.scale_uncertainty > 0.3


@pytest.mark.slow
def test_the_estimate_is_as_certain_as_it_says() -> None:
    scales, told = [], []
    for seed in range(200):
        estimated, measured, _, _ = scene(30, 1.0, 0, seed)
        found = align_robustly(estimated, measured)
        scales.append(np.log(found.similarity.scale / 30.0))
        told.append(found.scale_uncertainty)
    assert np.std(scales) / np.mean(told) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("estimated", "measured", "told"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "n >= 3"),
        (np.zeros((4, 3)), np.zeros((5, 3)), r"\(4, 3\) and \(5, 3\)"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), "NaN"),
    ],
)
def test_bad_input_is_refused(estimated: np.ndarray, measured: np.ndarray, told: str) -> None:
    with pytest.raises(GraphError, match=told):
        align_robustly(estimated, measured)


@pytest.mark.slow
def test_few_right_positions_are_rarely_called_wrong() -> None:
    wrong = sum(
        int((~align_robustly(*scene(n, 1.0, 0, seed)[:2]).right).sum()) for n in (3, 5, 8, 30) for seed in range(50)
    )
    assert wrong <= 7  # of 2,300
