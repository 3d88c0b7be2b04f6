"""Photographs and masks that COLMAP cannot read as they are have features like those that it can read."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from photograph_databases import extract_and_match
from rendered_corner import HEIGHT, WIDTH, render_corner, write_jpeg

from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageLog
from colmap_vg.features.photographs import find_photographs
from colmap_vg.features.pixels import stretched
from colmap_vg.jobs.image_folder import make_database
from colmap_vg.options import FeatureOptions

QUICK = {"num_threads": 2, "max_num_features": 500, "max_image_size": 240}


@pytest.fixture(scope="module")
def images():
    return render_corner(3).images


def _features(path: Path) -> dict[str, tuple[pycolmap.Camera, np.ndarray]]:
    with pycolmap.Database.open(path) as database:
        return {
            image.name: (database.read_camera(image.camera_id), database.read_keypoints(image.image_id))
            for image in database.read_all_images()
        }


@pytest.mark.parametrize("suffix", [".webp", ".jp2", ".avif"])
def test_formats_that_opencv_alone_reads(tmp_path, images, suffix):
    folder = tmp_path / "images"
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k}{suffix}"), image)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.imread(str(folder / f"{k}{suffix}")))
    assert pycolmap.Bitmap.read(folder / f"0{suffix}", False) is None
    before = sorted(folder.iterdir())
    result = make_database(folder, tmp_path / "out", FeatureOptions(**QUICK))
    assert not result.skipped
    found = _features(tmp_path / "out" / "database.db")
    for k in range(len(images)):
        assert found[f"{k}{suffix}"][0].width == WIDTH
        assert len(found[f"{k}{suffix}"][1]) > 100
        assert np.array_equal(found[f"{k}{suffix}"][1], found[f"{k}.png"][1])
    assert sorted(folder.iterdir()) == before
    assert not (tmp_path / "out" / ".work" / "copies").exists()


def test_exif_goes_into_copies(tmp_path, images):
    folder = tmp_path / "images"
    folder.mkdir()
    stored = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    for k, image in enumerate(images):
        write_jpeg(folder / f"{k}.jpg", image, orientation=6, focal_35mm=41)
        pixels, kinds, metadata = cv2.imreadWithMetadata(str(folder / f"{k}.jpg"), stored)
        cv2.imwriteWithMetadata(str(folder / f"{k}.webp"), pixels, kinds, metadata, [cv2.IMWRITE_WEBP_QUALITY, 101])
    extract_and_match(folder, tmp_path / "a.db", FeatureOptions(features="colmap", **QUICK))  # one decoder for both
    found = _features(tmp_path / "a.db")
    for k in range(len(images)):
        jpeg, webp = found[f"{k}.jpg"], found[f"{k}.webp"]
        assert webp[0].has_prior_focal_length
        assert np.array_equal(webp[0].params, jpeg[0].params)
        assert np.array_equal(webp[1], jpeg[1])


def test_twelve_bits_in_sixteen_are_stretched(tmp_path, images):
    folder = tmp_path / "images"
    folder.mkdir()
    for k, image in enumerate(images):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        cv2.imwrite(str(folder / f"{k}.png"), grey)
        for suffix in (".png", ".tif"):
            cv2.imwrite(str(folder / f"{k}-dark{suffix}"), grey.astype(np.uint16) * 16)
    extract_and_match(folder, tmp_path / "a.db", FeatureOptions(**QUICK))
    found = _features(tmp_path / "a.db")
    for k in range(len(images)):
        for suffix in (".png", ".tif"):
            assert abs(len(found[f"{k}-dark{suffix}"][1]) / len(found[f"{k}.png"][1]) - 1.0) < 0.05


def test_stretching_fills_the_bits_and_keeps_the_rest():
    assert stretched(np.array([[0, 4095]], dtype=np.uint16)).tolist() == [[0, 65520]]
    assert stretched(np.array([[0, 0]], dtype=np.uint16)).tolist() == [[0, 0]]
    assert stretched(np.array([[0, 65535]], dtype=np.uint16)).tolist() == [[0, 65535]]
    assert stretched(np.array([[0, 15]], dtype=np.uint8)).tolist() == [[0, 15]]


def test_a_jpeg_that_lacks_its_end_marker_only(tmp_path, images):
    for name, options in (("a", []), ("b", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])):
        data = cv2.imencode(".jpg", images[0], options)[1].tobytes()
        assert data.endswith(b"\xff\xd9")
        (tmp_path / f"{name}.jpg").write_bytes(data[:-2])
        (tmp_path / f"{name}-cut.jpg").write_bytes(data[: int(0.9 * len(data))])
    photographs, skipped = find_photographs(tmp_path)
    assert [photograph.name for photograph in photographs] == ["a.jpg", "b.jpg"]
    assert {file.reason for file in skipped} == {"the JPEG file is truncated"}


def test_a_heif_file_is_named_with_what_converts_it(tmp_path):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 100)
    (file,) = find_photographs(tmp_path)[1]
    assert "pillow-heif" in file.reason


def test_masks_by_other_names_and_photographs_without(tmp_path, images):
    folder, masks = tmp_path / "images", tmp_path / "masks"
    for path in (folder, masks):
        path.mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for name in ("a.jpg.png", "b.png", "c.mask.png", "d.jpg", "e.jpg.jpg"):
        cv2.imwrite(str(masks / name), mask)
        cv2.imwrite(str(folder / f"{name[0]}.jpg"), images[0])
    for name in ("whole.jpg", "all.jpg"):
        cv2.imwrite(str(folder / name), images[1])
    log = StageLog()
    result = extract_and_match(folder, tmp_path / "a.db", FeatureOptions(mask_path=masks, **QUICK), log)
    assert not result.skipped
    assert [warning for warning in log.warnings if "mask" in warning] == [
        f"2 photographs have no mask in {masks}, and are used whole: all.jpg, whole.jpg"
    ]
    found = {name: keypoints[:, 0].max() for name, (_, keypoints) in _features(tmp_path / "a.db").items()}
    assert all(found[f"{name}.jpg"] < WIDTH // 2 + 1 for name in "abcde")
    assert found["all.jpg"] > WIDTH // 2 + 50


def test_masks_beside_the_photographs(tmp_path, images):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), image)
        cv2.imwrite(str(tmp_path / f"{k}.mask.png"), mask)
    extract_and_match(tmp_path, tmp_path / "a.db", FeatureOptions(mask_path=tmp_path / ".", **QUICK))
    found = _features(tmp_path / "a.db")
    assert sorted(found) == ["0.jpg", "1.jpg", "2.jpg"]
    assert all(keypoints[:, 0].max() < WIDTH // 2 + 1 for _, keypoints in found.values())


def test_no_mask_at_all_is_an_error(tmp_path, images):
    (tmp_path / "masks").mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), image)
    with pytest.raises(ImageFolderError, match=r"the mask of 0\.jpg is 0\.jpg\.png"):
        extract_and_match(tmp_path, tmp_path / "a.db", FeatureOptions(mask_path=tmp_path / "masks", **QUICK))


def test_linked_folders_are_searched_once(tmp_path, images):
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "images"
    for path in (elsewhere, folder):
        path.mkdir()
    cv2.imwrite(str(elsewhere / "a.jpg"), images[0])
    (folder / "day1").symlink_to(elsewhere)
    (elsewhere / "loop").symlink_to(folder)
    assert [photograph.name for photograph in find_photographs(folder)[0]] == ["day1/a.jpg"]


def test_sidecar_files_have_one_warning(tmp_path, images):
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), image)
    for k in range(30):
        (tmp_path / f"{k:02d}.xmp").write_text("sidecar")
    log = StageLog()
    extract_and_match(tmp_path, tmp_path / "a.db", FeatureOptions(**QUICK), log)
    (warning,) = [warning for warning in log.warnings if "xmp" in warning]
    assert warning == "skipped 30 files (00.xmp, 01.xmp, 02.xmp, 03.xmp, 04.xmp, ...): each is no photograph"
