"""Huge databases are thinned, or refused, before they fill the memory."""

from pathlib import Path

import numpy as np
import pytest
from synthetic_databases import make_database

from colmap_vg.colmap_io import memory
from colmap_vg.colmap_io.memory import BYTES_PER_MATCH, USABLE_SHARE, affordable_matches_per_pair, available_memory
from colmap_vg.colmap_io.tables import read_tables
from colmap_vg.errors import DatabaseError
from colmap_vg.options import ReadOptions
from colmap_vg.reading.read import read_with_caveats


def room_for(num_matches: float) -> float:
    return num_matches * BYTES_PER_MATCH / USABLE_SHARE


@pytest.mark.parametrize("seed", range(20))
def test_the_cap_is_the_largest_that_fits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = rng.integers(1, 3000, rng.integers(1, 200))
    room = room_for(float(rng.uniform(0.3, 0.99)) * numbers.sum())
    cap = affordable_matches_per_pair(numbers, room)
    fits = [c for c in range(3001) if np.minimum(numbers, c).sum() * BYTES_PER_MATCH <= USABLE_SHARE * room]
    assert cap == (fits[-1] if fits[-1] >= memory.MIN_MATCHES_PER_PAIR else None)
    assert affordable_matches_per_pair(numbers, room_for(1.001 * numbers.sum())) == 0


def test_what_colmap_could_not_hold_is_refused() -> None:
    assert affordable_matches_per_pair(np.full(10**6, 1000), room_for(10**7)) is None
    assert affordable_matches_per_pair(np.zeros(0, dtype=np.int64), 0.0) == 0


def test_a_database_beyond_the_memory_is_thinned_with_a_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    make_database(path, num_images=4, num_points=200, noise_px=0.3)
    whole = read_tables(path)
    assert whole.caveats == ()
    monkeypatch.setattr("colmap_vg.colmap_io.tables.available_memory", lambda: room_for(6 * 80))
    thin = read_tables(path)
    assert np.diff(thin.offsets).tolist() == [80] * 6
    for k in range(6):
        every = whole.matches[whole.offsets[k] : whole.offsets[k + 1]].tolist()
        kept = thin.matches[thin.offsets[k] : thin.offsets[k + 1]].tolist()
        assert [row for row in every if row in kept] == kept
        assert kept[0] == every[0]
        assert kept[-1] == every[-1]
    graph, caveats = read_with_caveats(path, ReadOptions())
    assert "1,200 matches do not fit into memory" in caveats[0]
    assert "80 of each pair" in caveats[0]
    assert (graph.read_verdicts == "kept").all()


def test_a_database_far_beyond_the_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_database(tmp_path / "database.db", num_images=4, num_points=60)
    monkeypatch.setattr("colmap_vg.colmap_io.tables.available_memory", lambda: 1000.0)
    with pytest.raises(DatabaseError, match=r"360 matches of 6 pairs .* memory are free"):
        read_tables(tmp_path / "database.db")


def test_limits_of_the_process_and_its_group_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2**20 < available_memory() < 2**50
    (tmp_path / "max").write_text("1000000\n")
    (tmp_path / "current").write_text("400000\n")
    monkeypatch.setattr(memory, "_CGROUPS", ((tmp_path / "max", tmp_path / "current"),))
    assert available_memory() == 600000
    (tmp_path / "max").write_text("max\n")
    assert available_memory() > 600000
