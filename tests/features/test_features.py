"""Photographs are checked before anything is extracted, and the database holds what pycolmap alone would put there."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from photograph_databases import extract_and_match
from rendered_corner import HEIGHT, WIDTH, Corner, render_corner, write_jpeg

from colmap_vg.errors import ImageFolderError, OptionError
from colmap_vg.events import StageLog
from colmap_vg.features.extraction import extract_features, read_image_list
from colmap_vg.features.matching import match_features
from colmap_vg.features.photographs import Photograph, find_photographs, split_odd_sizes
from colmap_vg.features.sift_extraction import extract_sift, image_features
from colmap_vg.options import FeatureOptions

QUICK = {"num_threads": 2, "max_num_features": 500, "max_image_size": 240}


@pytest.fixture(scope="module")
def corner() -> Corner:
    return render_corner(3)


def reasons(folder: Path) -> dict[str, str]:
    return {file.name: file.reason for file in find_photographs(folder)[1]}


def database_rows(path: Path) -> dict[str, tuple[pycolmap.Camera, np.ndarray]]:
    with pycolmap.Database.open(path) as database:
        return {
            image.name: (database.read_camera(image.camera_id), database.read_keypoints(image.image_id))
            for image in database.read_all_images()
        }


def test_sizes_are_those_that_pycolmap_reads(tmp_path: Path, corner: Corner) -> None:
    image = corner.images[0]
    write_jpeg(tmp_path / "a.jpg", image[:200], orientation=6)
    for name in ("b.png", "c.tif", "d.bmp", "e.jpeg"):
        cv2.imwrite(str(tmp_path / name), image[:, :300])
    cv2.imwrite(str(tmp_path / "progressive.jpg"), image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    cv2.imwrite(str(tmp_path / "restarts.jpg"), image, [cv2.IMWRITE_JPEG_RST_INTERVAL, 4])
    photographs, skipped = find_photographs(tmp_path)
    assert not skipped
    assert len(photographs) == 7
    for photograph in photographs:
        bitmap = pycolmap.Bitmap.read(tmp_path / photograph.name, False)
        assert (photograph.width, photograph.height) == (bitmap.width, bitmap.height), photograph.name


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.999])
def test_truncated_files_are_skipped(tmp_path: Path, corner: Corner, suffix: str, share: float) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), corner.images[0])
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert reasons(tmp_path)[path.name]


def test_trailing_bytes_do_no_harm(tmp_path: Path, corner: Corner) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), corner.images[0])
    with (tmp_path / "a.jpg").open("ab") as file:
        file.write(b"a phone maker's own trailer")
    assert not reasons(tmp_path)


def test_every_other_kind_of_bad_file_is_named(tmp_path: Path, corner: Corner) -> None:
    cv2.imwrite(str(tmp_path / "flipped.png"), corner.images[0])
    data = bytearray((tmp_path / "flipped.png").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "flipped.png").write_bytes(data)
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("no image")
    (tmp_path / "notes.txt").write_text("no image")
    cv2.imwrite(str(tmp_path / "tiny.png"), corner.images[0][:10, :10])
    (tmp_path / ".hidden.jpg").write_bytes(b"")
    (tmp_path / ".folder").mkdir()
    (tmp_path / ".folder" / "a.jpg").write_bytes(b"")
    found = reasons(tmp_path)
    assert sorted(found) == ["empty.jpg", "flipped.png", "notes.txt", "text.jpg", "tiny.png"]
    assert "empty" in found["empty.jpg"]
    assert "checksum" in found["flipped.png"]
    assert "10 x 10" in found["tiny.png"]


def test_odd_sizes_are_skipped_only_where_a_camera_is_shared() -> None:
    sizes = {"a/1": (40, 60), "a/2": (60, 40), "a/3": (60, 40), "b/1": (40, 60), "b/2": (40, 60)}
    photographs = [Photograph(name, *size) for name, size in sizes.items()]

    def skipped(mode: str, one_calibration: bool) -> list[str]:
        return [file.name for file in split_odd_sizes(photographs, mode, one_calibration)[1]]  # type: ignore[arg-type]

    assert skipped("auto", False) == skipped("per_image", False) == []
    assert skipped("per_folder", False) == ["a/1"]
    assert skipped("single", False) == ["a/2", "a/3"]
    assert skipped("auto", True) == ["a/2", "a/3"]


def test_keypoints_are_in_stored_pixels_whatever_the_exif_orientation(tmp_path: Path, corner: Corner) -> None:
    for name, orientation in (("none", None), ("up", 1), ("left", 6), ("right", 8), ("zero", 0)):
        write_jpeg(tmp_path / f"{name}.jpg", corner.images[0], orientation=orientation, focal_35mm=28)
    extract_and_match(tmp_path, tmp_path / "database.db", FeatureOptions(num_threads=2, max_num_features=2000))
    rows = database_rows(tmp_path / "database.db")
    reference = rows["none.jpg"][1][:, :2]
    for name, (camera, keypoints) in rows.items():
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert camera.has_prior_focal_length
        distances = np.linalg.norm(keypoints[:, None, :2] - reference[None], axis=2).min(axis=1)
        assert np.mean(distances < 1.0) > 0.9, name


def test_features_of_opencv_and_colmap_match(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    path, names = tmp_path / "a.db", sorted(file.name for file in (tmp_path / "images").iterdir())
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, tmp_path / "images")
    options, log = FeatureOptions(num_threads=2), StageLog()
    with log.stage("features"):
        extract_sift(tmp_path / "images", path, names[1:2], options, log)
    first = database_rows(path)[names[1]][1]
    assert len(first) > 1000
    extract_features(tmp_path / "images", path, names, replace(options, features="colmap"), log)
    rows = database_rows(path)
    np.testing.assert_array_equal(rows[names[1]][1], first)
    assert len(rows[names[2]][1]) > 100
    match_features(path, options, log)
    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        mixed = [database.read_two_view_geometry(ids[names[1]], ids[name]) for name in (names[0], names[2])]
    assert all(len(geometry.inlier_matches) >= 100 for geometry in mixed)


def test_formats_that_opencv_cannot_read_are_read_by_colmap(tmp_path: Path, corner: Corner) -> None:
    grey = np.ascontiguousarray(corner.images[0][..., 1])
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    assert pycolmap.Bitmap.from_array(grey).write(str(tmp_path / "a.tga"))
    assert cv2.imread(str(tmp_path / "a.tga")) is None
    png, tga = (image_features(tmp_path, name, FeatureOptions()) for name in ("a.png", "a.tga"))
    np.testing.assert_array_equal(png.keypoints, tga.keypoints)
    with pytest.raises(ImageFolderError, match="can no longer be read"):
        image_features(tmp_path, "b.png", FeatureOptions())


def test_database_is_pycolmaps_own_and_numbered_by_name(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    write_jpeg(tmp_path / "images" / "folder.jpg", corner.images[1], focal_35mm=28)
    result = extract_and_match(tmp_path / "images", tmp_path / "ours.db", FeatureOptions(features="colmap", **QUICK))
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = 1, QUICK["max_image_size"]
    options.sift.max_num_features = QUICK["max_num_features"]
    pycolmap.extract_features(tmp_path / "theirs.db", tmp_path / "images", extraction_options=options)
    ours, theirs = database_rows(tmp_path / "ours.db"), database_rows(tmp_path / "theirs.db")
    assert list(ours) == sorted(ours) == list(result.image_names)
    assert set(ours) == set(theirs)
    for name, (camera, keypoints) in theirs.items():
        assert ours[name][0].params.tolist() == camera.params.tolist()
        np.testing.assert_array_equal(ours[name][1], keypoints)
    assert result.num_verified_pairs >= 3


def test_a_second_call_keeps_what_is_there(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    first = extract_and_match(tmp_path / "images", tmp_path / "a.db", FeatureOptions(**QUICK))
    before = database_rows(tmp_path / "a.db")
    assert extract_and_match(tmp_path / "images", tmp_path / "a.db", FeatureOptions(**QUICK)) == first
    after = database_rows(tmp_path / "a.db")
    assert list(before) == list(after)
    for name in before:
        np.testing.assert_array_equal(before[name][1], after[name][1])


def test_given_calibration_is_a_prior_of_one_camera(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    write_jpeg(tmp_path / "images" / "odd.jpg", corner.images[0][:, :400])
    options = FeatureOptions(
        camera_model="PINHOLE", camera_params=(450.0, 451.0, 240.0, 180.0), camera_mode="single", **QUICK
    )
    log = StageLog()
    extract_and_match(tmp_path / "images", tmp_path / "a.db", options, log)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        (camera,) = database.read_all_cameras()
    assert camera.params.tolist() == [450.0, 451.0, 240.0, 180.0]
    assert camera.has_prior_focal_length
    assert len(log.warnings) == 1
    assert "odd.jpg" in log.warnings[0]
    assert "400 x 360" in log.warnings[0]


def test_masks_hide_features(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    (tmp_path / "images" / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for index in range(3):
        cv2.imwrite(str(tmp_path / "images" / "masks" / f"{index:02d}.jpg.png"), mask)
    options = FeatureOptions(mask_path=tmp_path / "images" / "masks", **QUICK)
    result = extract_and_match(tmp_path / "images", tmp_path / "a.db", options)
    assert result.image_names == ("00.jpg", "01.jpg", "02.jpg")
    for _, keypoints in database_rows(tmp_path / "a.db").values():
        assert len(keypoints) > 20
        assert keypoints[:, 0].max() < WIDTH // 2 + 1


def test_image_list_confines_the_search(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    corner.write(tmp_path / "images" / "more")
    (tmp_path / "list.txt").write_text("# chosen\n00.jpg\nmore/01.jpg\n\n02.jpg\ngone.jpg\n")
    options = FeatureOptions(image_list_path=tmp_path / "list.txt", **QUICK)
    result = extract_and_match(tmp_path / "images", tmp_path / "a.db", options)
    assert result.image_names == ("00.jpg", "02.jpg", "more/01.jpg")
    assert [file.name for file in result.skipped] == ["gone.jpg"]
    with pytest.raises(ImageFolderError, match="image list"):
        read_image_list(tmp_path / "nothing.txt")


def test_what_cannot_work_is_refused_before_a_database_is_made(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    path = tmp_path / "a.db"
    with pytest.raises(ImageFolderError, match="no such image folder"):
        extract_and_match(tmp_path / "gone", path)
    with pytest.raises(ImageFolderError, match="is a file"):
        extract_and_match(tmp_path / "images" / "00.jpg", path)
    with pytest.raises(OptionError, match="unknown camera model 'PINHOL'"):
        extract_and_match(tmp_path / "images", path, FeatureOptions(camera_model="PINHOL"))
    with pytest.raises(OptionError, match="PINHOLE takes 4 camera parameters"):
        extract_and_match(tmp_path / "images", path, FeatureOptions(camera_model="PINHOLE", camera_params=(1.0, 2.0)))
    (tmp_path / "images" / "02.jpg").write_bytes(b"")
    with pytest.raises(ImageFolderError, match=r"2 photographs that can be used.*02\.jpg: the file is empty"):
        extract_and_match(tmp_path / "images", path)
    assert not path.exists()


def test_spatial_matching_without_positions_is_refused(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    with pytest.raises(ImageFolderError, match="GPS position"):
        extract_and_match(tmp_path / "images", tmp_path / "a.db", FeatureOptions(matching="spatial", **QUICK))


def test_portrait_and_landscape_match_with_cameras_of_their_own(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    write_jpeg(tmp_path / "images" / "01.jpg", np.ascontiguousarray(np.rot90(corner.images[1])))
    extract_and_match(tmp_path / "images", tmp_path / "a.db", FeatureOptions(num_threads=2, max_num_features=1500))
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        cameras = {image.name: database.read_camera(image.camera_id) for image in database.read_all_images()}
        assert database.read_two_view_geometry(1, 2).inlier_matches.shape[0] > 30
        assert database.read_two_view_geometry(2, 3).inlier_matches.shape[0] > 30
    assert (cameras["01.jpg"].width, cameras["01.jpg"].height) == (HEIGHT, WIDTH)
    assert (cameras["00.jpg"].width, cameras["00.jpg"].height) == (WIDTH, HEIGHT)


def test_sequential_matching_pairs_neighbours_only(tmp_path: Path, corner: Corner) -> None:
    corner.write(tmp_path / "images")
    options = FeatureOptions(matching="sequential", sequential_overlap=1, **QUICK)
    extract_and_match(tmp_path / "images", tmp_path / "a.db", options)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        assert database.exists_matches(1, 2)
        assert database.exists_matches(2, 3)
        assert not database.exists_matches(1, 3)
