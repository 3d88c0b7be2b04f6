"""Matches of a pair as the explorer sorts and draws them."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_vg import MappingOptions
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import synthetic_views
from colmap_vg.viewer.finished_job import FinishedJob, read_finished_job
from colmap_vg.viewer.pair_matches import COLORS, MatchKind, PairMatches, pair_matches, picture
from colmap_vg.viewer.session import Session

NUM_WRONG = 12
"""Matches of the first pair that verification rejects."""


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> FinishedJob:
    folder = tmp_path_factory.mktemp("matches")
    views = synthetic_views("drone", 9, noise_px=0.3, wrong_match_share=0.1, wrong_pair_share=0.0)
    write_synthetic_database(folder / "database.db", views)
    i, j = (int(k) for k in views.pairs[0])
    rejected = np.stack([np.arange(NUM_WRONG), np.arange(NUM_WRONG)[::-1] + 40], axis=1).astype(np.uint32)
    raw = np.concatenate([views.matches[0].astype(np.uint32), rejected])
    with closing(sqlite3.connect(folder / "database.db")) as connection, connection:
        pair = (i + 1) * 2_147_483_647 + j + 1
        connection.execute("UPDATE matches SET rows = ?, data = ? WHERE pair_id = ?", (len(raw), raw.tobytes(), pair))
    mapper(folder / "database.db", None, folder / "out", MappingOptions(), False, Reporter(quiet=True), False)
    return read_finished_job(folder / "out")


def test_matches_are_sorted_by_what_became_of_them(job: FinishedJob) -> None:
    session = Session(job)
    found = pair_matches(job, session.before, 0)
    counts = {kind: int((found.kinds == kind).sum()) for kind in MatchKind}
    verified = int(np.diff(job.graph.inlier_offsets)[0])
    assert counts[MatchKind.AGREES] + counts[MatchKind.CONTRADICTS] == verified
    assert counts[MatchKind.REJECTED] == NUM_WRONG
    # A tenth of the verified matches are wrong, most of which are more than 4 px from their epipolar line.
    assert 0.05 < counts[MatchKind.CONTRADICTS] / verified < 0.15
    assert found.told().startswith(f"{counts[MatchKind.AGREES]} green: verified")
    session.exclude_image(0)
    session.solve()
    kinds = pair_matches(job, session.after, 0).kinds
    assert set(kinds.tolist()) == {"unsolved", "rejected"}


def test_the_picture_shows_matches_on_both_photographs(job: FinishedJob, tmp_path: Path) -> None:
    for name, level in zip(job.graph.image_names[:2], (60, 200), strict=True):
        cv2.imwrite(str(tmp_path / name), np.full((1200, 1600, 3), level, np.uint8))
    seen = replace(job, image_path=tmp_path)
    pair = job.graph.edges.tolist().index([0, 1])
    points = np.array([[800.0, 600.0]])
    drawn = picture(seen, pair, PairMatches(points, points, np.array(["agrees"])))
    assert np.abs(drawn[5, 5].astype(int) - 60).max() < 3
    assert np.abs(drawn[5, -5].astype(int) - 200).max() < 3
    np.testing.assert_array_equal(drawn[180, 240], COLORS[MatchKind.AGREES])  # (800, 600) of 1600 x 1200 at height 360
    nothing = picture(job, pair, PairMatches(points[:0], points[:0], np.zeros(0, dtype=str)))
    assert (nothing[5, 5] == nothing[5, -5]).all()  # grey: no photographs


@pytest.mark.parametrize("name", ["../secret.jpg", "{}/secret.jpg", "a/../../secret.jpg"])
def test_photographs_outside_of_the_folder_are_not_read(job: FinishedJob, tmp_path: Path, name: str) -> None:
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "secret.jpg"), np.full((40, 40, 3), 255, np.uint8))
    names = (name.format(tmp_path), *job.graph.image_names[1:])
    renamed = replace(job, image_path=tmp_path / "images", graph=replace(job.graph, image_names=names))
    pair = job.graph.edges.tolist().index([0, 1])
    drawn = picture(renamed, pair, PairMatches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=str)))
    assert (drawn[5, 5] == 110).all()
