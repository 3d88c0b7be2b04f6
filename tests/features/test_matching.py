"""The selected pairs are matched, whatever the images are called and however a job ended."""

import itertools
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from photograph_databases import extract_and_match
from rendered_corner import Corner, render_corner, write_jpeg

from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageLog
from colmap_vg.features import matching, pair_matching, pairings
from colmap_vg.features.matching import match_features, match_pairs
from colmap_vg.features.orientation_votes import excess_over_chance
from colmap_vg.features.pair_selection import preemptive_matches, select_pairs
from colmap_vg.features.pairings import selected_pairs, sequential_pairs
from colmap_vg.features.shortlist import partners_of_partners
from colmap_vg.options import FeatureOptions

QUICK = FeatureOptions(num_threads=2, max_num_features=500, max_image_size=240)
NAMES = ("a photo (1).jpg", "#2.jpg", "füñf/100 %.jpg", "plain.jpg")


@pytest.fixture(scope="module")
def corner() -> Corner:
    return render_corner(4)


@pytest.fixture
def images(tmp_path: Path, corner: Corner) -> Path:
    for name, image in zip(NAMES, corner.images, strict=True):
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_jpeg(path, image)
    return tmp_path / "images"


def matched(path: Path) -> dict[tuple[str, str], np.ndarray]:
    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pairs = [(a, b) for a in names for b in names if a < b and database.exists_matches(a, b)]
        return {(names[a], names[b]): database.read_two_view_geometry(a, b).inlier_matches for a, b in pairs}


def test_selected_pairs_have_nearly_all_matches_of_exhaustive_matching(tmp_path: Path, images: Path) -> None:
    extract_and_match(images, tmp_path / "all.db", replace(QUICK, matching="exhaustive"))
    result = extract_and_match(images, tmp_path / "some.db", replace(QUICK, matching="selected"))
    every, some = matched(tmp_path / "all.db"), matched(tmp_path / "some.db")
    assert set(result.image_names) == set(NAMES)
    assert {name for pair in some for name in pair} == set(NAMES)
    assert sum(map(len, some.values())) >= 0.97 * sum(map(len, every.values()))
    for pair, rows in some.items():
        found, by_brute_force = ({tuple(row) for row in matches.tolist()} for matches in (rows, every[pair]))
        assert len(found & by_brute_force) >= 0.9 * len(by_brute_force), pair


def test_given_pairs_are_matched_and_no_others(tmp_path: Path, images: Path) -> None:
    path = tmp_path / "a.db"
    extract_and_match(images, path, replace(QUICK, matching="sequential", sequential_overlap=1))
    with pycolmap.Database.open(path) as database:
        database.clear_matches()
        database.clear_two_view_geometries()
    log = StageLog()
    with log.stage("matching"):
        match_pairs(path, [(NAMES[1], NAMES[0]), (NAMES[3], NAMES[2])], QUICK, log)
    assert {frozenset(pair) for pair in matched(path)} == {frozenset(NAMES[:2]), frozenset(NAMES[2:])}
    assert sorted(file.name for file in tmp_path.iterdir() if file.is_file()) == ["a.db"]


def test_interrupted_matching_goes_on_with_what_is_missing(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, options = tmp_path / "a.db", replace(QUICK, matching="selected")
    extract_and_match(images, path, options)
    before = matched(path)
    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        first, *_ = before
        database.delete_matches(*(ids[name] for name in first))
        database.delete_two_view_geometry(*(ids[name] for name in first))
    assert set(matched(path)) == set(before) - {first}
    match_features(path, options, StageLog())
    after = matched(path)
    assert set(after) == set(before)
    for pair in before:
        np.testing.assert_array_equal(before[pair], after[pair])


def test_weak_pairs_are_matched_in_full_where_an_image_has_few_others(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.db"
    monkeypatch.setattr(matching, "MAX_FIRST_FEATURES", 60)
    monkeypatch.setattr(pair_matching, "MIN_CONSISTENT", 1000)  # so that no pair is verified by its largest features
    extract_and_match(images, path, QUICK)
    assert sum(len(rows) > 0 for rows in matched(path).values()) >= 5
    monkeypatch.setattr(matching, "MIN_VERIFIED_PARTNERS", 0)
    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        database.clear_two_view_geometries()
        for first, second in itertools.combinations(NAMES, 2):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((20 * (NAMES[3] not in (first, second)), 2), np.uint32)
            database.write_two_view_geometry(ids[first], ids[second], geometry)
    match_features(path, QUICK, StageLog())
    rescued = [pair for pair, rows in matched(path).items() if len(rows) not in (0, 20)]
    assert rescued
    assert all(NAMES[3] in pair for pair in rescued)


def test_threads_do_not_change_matches(tmp_path: Path, images: Path) -> None:
    for threads in (1, 3):
        extract_and_match(images, tmp_path / f"{threads}.db", replace(QUICK, num_threads=threads))
    one, three = matched(tmp_path / "1.db"), matched(tmp_path / "3.db")
    assert set(one) == set(three)
    for pair, rows in one.items():
        np.testing.assert_array_equal(rows, three[pair])


def test_auto_matches_all_pairs_of_few_images_only(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.db"
    extract_and_match(images, path, QUICK)
    assert len(matched(path)) == 6
    with pycolmap.Database.open(path) as database:
        database.clear_matches()
        database.clear_two_view_geometries()
    monkeypatch.setattr(matching, "MAX_ALL_PAIRS", 3)
    monkeypatch.setattr(matching, "selected_pairs", lambda *_: [(NAMES[0], NAMES[1])])
    log = StageLog()
    match_features(path, QUICK, log)
    assert len(matched(path)) == 1
    assert "selected from 6" in log.records[-1].message


def test_a_photograph_of_something_else_costs_few_pairs(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    rng = np.random.default_rng(0)
    for index in range(4):
        write_jpeg(tmp_path / "images" / f"noise{index}.jpg", rng.integers(0, 255, (360, 480, 3)).astype(np.uint8))
    extract_and_match(tmp_path / "images", tmp_path / "a.db", QUICK)
    log = StageLog()
    with log.stage("pairs"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(pairings, "select_pairs", partial(select_pairs, min_partners=1))
        pairs = selected_pairs(tmp_path / "a.db", 2, 0, log)
    noisy = [pair for pair in pairs if any(name.startswith("noise") for name in pair)]
    assert len(pairs) - len(noisy) >= 4
    assert len(noisy) <= 6  # of 22


def test_shortlists_get_positions_and_are_extended_by_shared_partners(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extract_and_match(images, tmp_path / "a.db", QUICK)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        image = database.read_all_images()[0]
        prior = pycolmap.PosePrior(position=np.array([4.0, 5.0, 6.0]))
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        prior.corr_data_id, prior.pose_prior_id = image.data_id, 1
        database.write_pose_prior(prior)
    chain, seen, tried = np.abs(np.subtract.outer(np.arange(4), np.arange(4))) == 1, [], []
    counts: list[tuple[np.ndarray, np.ndarray]] = []

    def shortlisted(descriptors: np.ndarray, positions: np.ndarray, seed: int) -> np.ndarray:
        seen.append(positions)
        return chain

    def matches(*arguments: object, candidates: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        tried.append(arguments[3] if candidates is None else candidates)
        counts.append(preemptive_matches(*arguments[:2], candidates=tried[-1]))
        return counts[-1]

    def more(scores: np.ndarray, known: np.ndarray, most: int) -> np.ndarray:
        assert most == pairings.MORE_CANDIDATES
        np.testing.assert_array_equal(scores, excess_over_chance(counts[0][1], counts[0][0]))
        return partners_of_partners(scores, known, most)

    def select(num_matches: np.ndarray, num_consistent: np.ndarray) -> np.ndarray:
        np.testing.assert_array_equal(num_matches, counts[0][0] + counts[1][0])
        np.testing.assert_array_equal(num_consistent, counts[0][1] + counts[1][1])
        return select_pairs(num_matches, num_consistent)

    monkeypatch.setattr(pairings, "shortlisted", shortlisted)
    monkeypatch.setattr(pairings, "preemptive_matches", matches)
    monkeypatch.setattr(pairings, "partners_of_partners", more)
    monkeypatch.setattr(pairings, "select_pairs", select)
    log = StageLog()
    with log.stage("pairs"):
        pairs = selected_pairs(tmp_path / "a.db", 1, 0, log)
    ordered = sorted(NAMES, key=pairings._natural)
    assert np.isfinite(seen[0]).all(axis=1).tolist() == [name == image.name for name in ordered]
    assert seen[0][ordered.index(image.name)].tolist() == [4.0, 5.0, 6.0]
    assert len(tried) == 2
    assert tried[1][0, 2]
    assert not (tried[1] & chain).any()
    assert all(matches.any() for matches, _ in counts)
    assert len(pairs) > 3


def test_photographs_without_features_are_no_obstacle(tmp_path: Path, images: Path) -> None:
    cv2.imwrite(str(images / "blank.png"), np.zeros((360, 480, 3), np.uint8))
    options = replace(QUICK, matching="selected")
    result = extract_and_match(images, tmp_path / "a.db", options)
    assert result.num_verified_pairs >= 3
    log = StageLog()
    with log.stage("pairs"):
        pairs = selected_pairs(tmp_path / "a.db", 1, 0, log)
    assert any("blank.png" in pair for pair in pairs)


def test_spatial_matching_pairs_those_that_were_near_and_the_others_by_features(tmp_path: Path) -> None:
    """Two at 30 m, one a kilometre away, one without a position, one of a receiver without a fix."""
    (tmp_path / "images").mkdir()
    north, east = (55.0, 55.00027, 55.0, 55.0, 55.01, None, 0.0), (13.0, 13.0, 13.005, 13.0051, 13.0, None, 0.0)
    for index, image in enumerate(render_corner(7).images):
        path = tmp_path / "images" / f"{index}.jpg"
        write_jpeg(path, image)
        if north[index] is not None:
            path.write_bytes(with_position(path.read_bytes(), north[index], east[index]))
    log = StageLog()
    extract_and_match(tmp_path / "images", tmp_path / "a.db", replace(QUICK, matching="spatial"), log)
    pairs = set(matched(tmp_path / "a.db"))
    placed = {"0.jpg", "1.jpg", "2.jpg", "3.jpg"}
    assert {pair for pair in pairs if placed.issuperset(pair)} == {("0.jpg", "1.jpg"), ("2.jpg", "3.jpg")}
    for name in ("4.jpg", "5.jpg", "6.jpg"):
        assert sum(name in pair for pair in pairs) >= 2
    told = [warning for warning in log.warnings if "matched by their features" in warning]
    assert [("5.jpg, 6.jpg" in warning, "4.jpg" in warning) for warning in told] == [(True, False), (False, True)]


def test_spatial_matching_needs_three_positions(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    path = tmp_path / "images" / "00.jpg"
    path.write_bytes(with_position(path.read_bytes(), 55.0, 13.0))
    with pytest.raises(ImageFolderError, match=r"1 of 4 photographs .* GPS position.*matching='auto'"):
        extract_and_match(tmp_path / "images", tmp_path / "a.db", replace(QUICK, matching="spatial"))


def with_position(jpeg: bytes, latitude: float, longitude: float) -> bytes:
    """A JPEG with an APP1 segment that holds a GPS directory: latitude north and longitude east in degrees."""

    def degrees(value: float) -> bytes:
        return struct.pack("<IIIIII", round(value * 10**7), 10**7, 0, 1, 0, 1)

    at = 8 + 2 + 12 + 4
    values = at + 2 + 5 * 12 + 4
    entries = [
        struct.pack("<HHI4s", 1, 2, 2, b"N"),
        struct.pack("<HHII", 2, 5, 3, values),
        struct.pack("<HHI4s", 3, 2, 2, b"E"),
        struct.pack("<HHII", 4, 5, 3, values + 24),
        struct.pack("<HHII", 6, 5, 1, values + 48),
    ]
    body = b"Exif\0\0II*\0" + struct.pack("<I", 8) + struct.pack("<HHHII", 1, 0x8825, 4, 1, at) + bytes(4)
    body += struct.pack("<H", 5) + b"".join(entries) + bytes(4)
    body += degrees(latitude) + degrees(longitude) + struct.pack("<II", 50, 1)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def test_frames_follow_each_other_as_people_count() -> None:
    names = [f"frame{k}.jpg" for k in range(1, 25)]
    shuffled = [names[k] for k in np.random.default_rng(0).permutation(24)]
    pairs = sequential_pairs(shuffled, 1)
    assert pairs == list(itertools.pairwise(names))
    near = {(a, b) for a, b in sequential_pairs(shuffled, 3) if a == "frame2.jpg"}
    assert near == {("frame2.jpg", f"frame{k}.jpg") for k in (3, 4, 5, 6)}  # three that follow, and the fourth


def test_folders_and_names_without_numbers_have_an_order() -> None:
    ordered = ["1/a.jpg", "2/a.jpg", "2/b.jpg", "10/a.jpg", "a1.jpg", "a01b.jpg", "a2.jpg", "a.jpg"]
    assert sequential_pairs(ordered[::-1], 1) == list(itertools.pairwise(ordered))
    assert sequential_pairs(["a.jpg"], 5) == []
