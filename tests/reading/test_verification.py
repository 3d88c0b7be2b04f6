"""Databases filled by others: placeholders, missing and foreign matrices, matches that nobody verified."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import centers, changed_copy, make_database

from colmap_vg import MappingOptions, align_positions
from colmap_vg.colmap_io.tables import read_tables
from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database
from colmap_vg.reading.verification import with_verified_geometries

IDENTITY = np.eye(3).tobytes()
NUM_IMAGES = 10
SPOILT = {
    "placeholders": ("UPDATE two_view_geometries SET E = ?, F = ?, H = ?, qvec = NULL, tvec = NULL", 3),
    "placeholder of F": ("UPDATE two_view_geometries SET E = NULL, F = ?, H = NULL, qvec = NULL, tvec = NULL", 1),
    "no matrices": (
        "UPDATE two_view_geometries SET E = NULL, F = NULL, H = NULL, qvec = NULL, tvec = NULL, config = 0",
        0,
    ),
}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    path = tmp_path_factory.mktemp("verified") / "a.db"
    return path, make_database(path, num_images=NUM_IMAGES, num_points=200, noise_px=0.5)


def mean_error(path: Path, truth: pycolmap.Reconstruction, tmp_path: Path) -> tuple[float, list[str]]:
    """Mean position error over the radius of the cameras, all of which must be registered; the warnings."""
    log = StageLog()
    before = path.read_bytes()
    model = map_database(path, None, tmp_path / "out", MappingOptions(), log).models[0]
    assert path.read_bytes() == before
    ids = sorted(truth.reg_image_ids())
    assert sorted(model.reg_image_ids()) == ids
    true_centers = centers(truth, ids)
    errors, _ = align_positions(centers(model, ids), true_centers)
    radius = np.sqrt(np.mean(np.sum((true_centers - true_centers.mean(axis=0)) ** 2, axis=1)))
    return float(errors.mean() / radius), log.warnings


@pytest.mark.parametrize("kind", SPOILT)
def test_spoilt_matrices_are_not_believed(
    kind: str, noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    statement, count = SPOILT[kind]
    path = changed_copy(noisy[0], tmp_path / "b.db", (statement, (IDENTITY,) * count))
    error, warnings = mean_error(path, noisy[1], tmp_path)
    assert error < 0.002
    (told,) = [warning for warning in warnings if "no matrix that explains" in warning]
    assert told.startswith("45 of 45 pairs")
    assert "unverified" not in told


def test_fundamental_matrices_of_other_pairs_are_not_believed(
    noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    shifted = (
        "UPDATE two_view_geometries SET E = NULL, H = NULL, qvec = NULL, tvec = NULL, config = 3, F = (SELECT F FROM"
        " two_view_geometries AS other WHERE other.pair_id > two_view_geometries.pair_id ORDER BY other.pair_id"
        " LIMIT 1)"
    )
    path = changed_copy(noisy[0], tmp_path / "b.db", shifted)
    tables, changed = with_verified_geometries(read_tables(path), 0)
    assert changed.mean() > 0.8
    assert np.isnan(tables.F[changed]).all()
    error, _ = mean_error(path, noisy[1], tmp_path)
    assert error < 0.002


@pytest.mark.parametrize("wrong_share", [0.1, 0.3, 0.5])
def test_unverified_matches_are_verified(
    wrong_share: float, noisy: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    statements: list[str | tuple[str, tuple[object, ...]]] = [SPOILT["no matrices"][0]]
    tables = read_tables(noisy[0])
    wrong = 0
    for pair, (i, j) in enumerate(tables.pairs.tolist()):
        matches = tables.matches[tables.offsets[pair] : tables.offsets[pair + 1]].astype(np.uint32)
        spoilt = rng.permutation(len(matches))[: round(wrong_share * len(matches))]
        matches[spoilt, 1] = rng.permutation(len(tables.keypoints[j]))[: len(spoilt)]
        wrong += len(spoilt)
        pair_id = pycolmap.image_pair_to_pair_id(*tables.image_ids[[i, j]].tolist())
        values = (len(matches), matches.tobytes(), pair_id)
        statements.append(("UPDATE two_view_geometries SET rows = ?, cols = 2, data = ? WHERE pair_id = ?", values))
    path = changed_copy(noisy[0], tmp_path / "b.db", *statements)
    verified, changed = with_verified_geometries(read_tables(path), 0)
    assert changed.all()
    removed = tables.offsets[-1] - verified.offsets[-1]
    assert 0.9 * wrong <= removed <= 1.1 * wrong
    error, warnings = mean_error(path, noisy[1], tmp_path)
    assert error < 0.003
    assert any("matches were not verified" in warning for warning in warnings)


def test_what_explains_its_matches_is_left_alone(noisy: tuple[Path, pycolmap.Reconstruction]) -> None:
    tables = read_tables(noisy[0])
    same, changed = with_verified_geometries(tables, 0)
    assert same is tables
    assert not changed.any()
