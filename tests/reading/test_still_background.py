"""Objects on turntables: the background stands still, and verification kept it alone."""

from pathlib import Path

import numpy as np
import pycolmap
from synthetic_databases import centers, make_database, sha256

from colmap_vg import MappingOptions, align_positions
from colmap_vg.colmap_io.tables import read_tables
from colmap_vg.events import StageLog
from colmap_vg.jobs.mapper import map_database
from colmap_vg.reading.still_background import without_still_background

NUM_STILL = 300


def add_still_background(path: Path, num_still: int = NUM_STILL) -> None:
    """Keypoints that stand still, and pairs of which they are the only inliers; the true matches are raw ones."""
    rng = np.random.default_rng(4)
    with pycolmap.Database.open(path) as database:
        images = database.read_all_images()
        lens = database.read_all_cameras()[0]
        wall = rng.uniform([0.0, 0.0], [lens.width, lens.height], (num_still, 2))
        first = {}
        for image in images:
            own = np.asarray(database.read_keypoints(image.image_id))
            seen = np.column_stack(
                [wall + rng.normal(0.0, 0.3, wall.shape), np.tile([1.0, 0.0, 0.0, 1.0], (num_still, 1))]
            )
            first[image.image_id] = len(own)
            database.update_keypoints(image.image_id, np.concatenate([own, seen[:, : own.shape[1]]]).astype(np.float32))
        ids = sorted(first)
        pairs = [(i, j) for i in ids for j in ids if i < j]
        moving = {pair: np.asarray(database.read_two_view_geometry(*pair).inlier_matches) for pair in pairs}
        database.clear_matches()
        database.clear_two_view_geometries()
        for i, j in pairs:
            still = np.column_stack([first[i] + np.arange(num_still), first[j] + np.arange(num_still)])
            database.write_matches(i, j, np.concatenate([moving[i, j], still]).astype(np.uint32))
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = int(pycolmap.TwoViewGeometryConfiguration.PANORAMIC)
            geometry.H = np.eye(3)
            geometry.inlier_matches = still.astype(np.uint32)
            database.write_two_view_geometry(i, j, geometry)


def test_the_object_is_reconstructed(tmp_path: Path) -> None:
    truth = make_database(tmp_path / "a.db", num_images=10, num_points=200, noise_px=0.5)
    add_still_background(tmp_path / "a.db")
    before, log = sha256(tmp_path / "a.db"), StageLog()
    models = map_database(tmp_path / "a.db", None, tmp_path / "out", MappingOptions(), log).models
    assert sha256(tmp_path / "a.db") == before
    assert "In 45 of 45 pairs the background does not move with the object" in " ".join(log.warnings)
    ids = sorted(truth.reg_image_ids())
    assert sorted(models[0].reg_image_ids()) == ids
    errors, _ = align_positions(centers(models[0], ids), centers(truth, ids))
    assert errors.mean() < 0.01 * np.std(centers(truth, ids), axis=0).max()
    # No point is the wall's.
    first = {i: models[0].image(i).num_points2D() - NUM_STILL for i in ids}
    seen = [(e.image_id, e.point2D_idx) for p in models[0].points3D.values() for e in p.track.elements]
    assert all(row < first[image] for image, row in seen)


def test_ordinary_databases_are_left_alone(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=6, num_points=100)
    tables = read_tables(tmp_path / "a.db")
    found, changed = without_still_background(tables, tmp_path / "a.db")
    assert found is tables
    assert not changed.any()
