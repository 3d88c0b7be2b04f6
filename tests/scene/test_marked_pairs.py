"""A user's marks on pairs: what is excluded is excluded, and trust overrules doubt of a pair's calibration only."""

import numpy as np

from colmap_vg import ViewGraph
from colmap_vg.scene.marked_pairs import with_marked_pairs

WORDS = ["kept", "uncalibrated", "no_pose", "kept", "uncalibrated"]


def graph(words: list[str] | None) -> ViewGraph:
    edges = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3]])
    directions = np.tile([0.0, 0.0, 1.0], (5, 1))
    verdicts = None if words is None else np.array(words)
    return ViewGraph(np.arange(4), edges, np.tile(np.eye(3), (5, 1, 1)), directions, read_verdicts=verdicts)


def test_excluded_pairs_are_not_trusted() -> None:
    excluded, trusted = np.array([1, 1, 0, 0, 0], dtype=bool), np.array([1, 0, 1, 0, 1], dtype=bool)
    marked = with_marked_pairs(graph(WORDS), excluded, trusted)
    assert marked.read_verdicts.tolist() == ["excluded", "excluded", "no_pose", "kept", "kept"]
    assert marked.trusted.tolist() == [False, False, True, False, True]


def test_without_marks_nothing_changes() -> None:
    none = np.zeros(5, dtype=bool)
    assert with_marked_pairs(graph(WORDS), none, none).trusted is None
    assert with_marked_pairs(graph(WORDS), none, none).read_verdicts.tolist() == WORDS
    assert with_marked_pairs(graph(None), ~none, none).read_verdicts.tolist() == ["excluded"] * 5
