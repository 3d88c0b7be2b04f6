"""Lists of pairs: what files say, and what excluded and trusted pairs do to a job."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_databases import centers, changed_copy, make_database, pair_id, sha256

from colmap_vg import (
    EdgeVerdict,
    MappingOptions,
    ReadOptions,
    align_positions,
    read_view_graph,
    solve_view_graph,
    view_graph_mapping,
)
from colmap_vg.colmap_io.pair_lists import listed_edges, pair_list, read_pair_list
from colmap_vg.errors import DataFileError
from colmap_vg.geometry import so3


def test_a_list_holds_two_names_a_line(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("# false\na.jpg b.jpg\n\nmy photo.jpg\tb.jpg\n", encoding="utf-8")
    assert read_pair_list(path) == [("a.jpg", "b.jpg"), ("my photo.jpg", "b.jpg")]
    edges = np.array([[1, 0], [0, 2], [1, 2]])
    assert listed_edges(path, ["a.jpg", "b.jpg", "my photo.jpg"], edges).tolist() == [True, False, True]
    assert not listed_edges(None, ["a.jpg", "b.jpg", "my photo.jpg"], edges).any()
    with pytest.raises(DataFileError, match=r"not images of the database .*my photo"):
        listed_edges(path, ["a.jpg", "b.jpg"], edges[:1])
    path.write_text("a.jpg b.jpg\na.jpg\n", encoding="utf-8")
    with pytest.raises(DataFileError, match="line 2: two image names"):
        read_pair_list(path)
    with pytest.raises(DataFileError, match="cannot read"):
        read_pair_list(tmp_path / "none.txt")


@pytest.fixture(scope="module")
def with_false_pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction, tuple[str, str]]:
    """Ten images; the matches of one pair are shifted against each other, so that its rotation is wrong."""
    folder = tmp_path_factory.mktemp("pairs")
    truth = make_database(folder / "true.db", num_points=300, noise_px=0.5)
    with pycolmap.Database.open(folder / "true.db") as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        wrong = database.read_two_view_geometry(2, 5).inlier_matches.copy()
        other = database.read_two_view_geometry(2, 9).inlier_matches
    # Image 5 takes the place of image 9 in the pair: its keypoints are numbered as that one's are.
    count = min(len(wrong), len(other))
    data = other[:count].astype(np.uint32).tobytes()
    changed_copy(
        folder / "true.db",
        folder / "false.db",
        ("UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?", (count, data, pair_id(2, 5))),
    )
    return folder / "false.db", truth, (names[2], names[5])


def test_excluded_pairs_leave_poses_and_points_alone(
    with_false_pair: tuple[Path, pycolmap.Reconstruction, tuple[str, str]], tmp_path: Path
) -> None:
    path, truth, names = with_false_pair
    before, pairs = sha256(path), tmp_path / "excluded.txt"
    pairs.write_text(" ".join(reversed(names)) + "\n", encoding="utf-8")
    read = ReadOptions(excluded_pairs_path=pairs)
    graph = read_view_graph(path, read)
    row = int(np.flatnonzero((np.sort(graph.image_ids[graph.edges], axis=1) == [2, 5]).all(axis=1))[0])
    solution = solve_view_graph(graph)
    assert solution.edge_verdicts[row] == EdgeVerdict.EXCLUDED
    assert not solution.edge_kept[row]
    model = view_graph_mapping(path, None, tmp_path / "out", MappingOptions(read=read))[0]
    ids = sorted(model.reg_image_ids())
    assert len(ids) == 10
    assert align_positions(centers(model, ids), centers(truth, ids))[0].max() < 0.05
    assert sha256(path) == before


def test_trusted_pairs_stay_whatever_contradicts_them(tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_points=300, noise_px=0.5)
    graph = read_view_graph(tmp_path / "a.db")
    names = [graph.image_names[i] for i in graph.edges[3]]
    pairs = tmp_path / "trusted.txt"
    pairs.write_text(f"{names[0]} {names[1]}\n", encoding="utf-8")
    trusted = read_view_graph(tmp_path / "a.db", ReadOptions(trusted_pairs_path=pairs)).trusted
    assert trusted is not None
    assert np.flatnonzero(trusted).tolist() == [3]
    wrong = graph.cam2_from_cam1_rotations.copy()
    wrong[3] = so3.exp(np.array([[0.0, 1.0, 0.0]]))[0] @ wrong[3]
    for word, given in ((EdgeVerdict.ROTATION_OUTLIER, None), (EdgeVerdict.KEPT, trusted)):
        solution = solve_view_graph(replace(graph, cam2_from_cam1_rotations=wrong, trusted=given))
        assert solution.edge_verdicts[3] == word


def test_written_lists_hold_any_name(tmp_path: Path) -> None:
    names = [
        "a.jpg",
        "#b.jpg",
        '["c.jpg"',
        "d e.jpg",
        "f\tg",
        "h\ni",
        " j ",
        "k\r",
        "ü 日本\u2028",
        '"l"',
        "a/b.jpg",
        "\x00",
    ]
    pairs = [(one, other) for one in names for other in names if one != other]
    path = tmp_path / "pairs.txt"
    path.write_text(pair_list(pairs), encoding="utf-8", newline="")
    assert read_pair_list(path) == pairs
    assert pair_list([("a.jpg", "b/c.jpg")]) == "a.jpg\tb/c.jpg\n"  # as COLMAP's lists
