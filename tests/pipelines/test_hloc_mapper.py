"""hloc's files to a model: its layout of features and matches, its convention of pixels, its arguments and results."""

import inspect
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import hloc_mapper
import numpy as np
import pycolmap
import pytest
from synthetic_databases import centers, make_database, sha256

import colmap_vg
from colmap_vg.errors import ColmapVgError, DataFileError, ImageFolderError, OptionError

ROOT = Path(__file__).parents[2]
CAMERA = {"camera_model": "SIMPLE_PINHOLE", "camera_params": "1280,512,384"}
NAMES = [f"{'left' if row % 2 else 'right'}/{row:02d}.jpg" for row in range(6)]


@dataclass
class Scene:
    """Files as hloc writes them, and the truth."""

    folder: Path
    truth: pycolmap.Reconstruction
    keypoints: dict[str, np.ndarray]
    matches: dict[tuple[str, str], np.ndarray]

    def arguments(self, output: Path, **changed: Any) -> dict[str, Any]:
        paths = {name: self.folder / f"{name}.h5" for name in ("features", "matches")}
        common = {"sfm_dir": output, "image_dir": self.folder / "images", "pairs": self.folder / "pairs.txt"}
        return {
            **common,
            **paths,
            "camera_mode": pycolmap.CameraMode.SINGLE,
            "image_options": CAMERA,
            "mapper_options": {"num_threads": 1},
            **changed,
        }


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("hloc")
    truth = make_database(folder / "synthetic.db", num_images=6, num_points=120, noise_px=0.5)
    _, blank = cv2.imencode(".jpg", np.full((768, 1024, 3), 90, np.uint8))
    keypoints, matches = {}, {}
    with pycolmap.Database.open(folder / "synthetic.db") as database, h5py.File(folder / "features.h5", "w") as file:
        images = sorted(database.read_all_images(), key=lambda image: image.image_id)
        for name, image in zip(NAMES, images, strict=True):
            (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "images" / name).write_bytes(blank.tobytes())
            keypoints[name] = database.read_keypoints(image.image_id)[:, :2]
            group = file.create_group(name)
            group.create_dataset("keypoints", data=keypoints[name] - 0.5)
            group.create_dataset("descriptors", data=np.zeros((2, len(keypoints[name])), np.float16))
        for i, first in enumerate(images):
            for j, second in enumerate(images[:i]):
                found = database.read_matches(first.image_id, second.image_id)
                matches[NAMES[i], NAMES[j]] = np.asarray(found, dtype=np.int64)
    (folder / "synthetic.db").unlink()
    with h5py.File(folder / "matches.h5", "w") as file:
        for count, ((first, second), found) in enumerate(matches.items()):
            # In turn: as listed, the pair the other way round, and the group names of hloc's first versions.
            names, columns = ((second, first), (1, 0)) if count % 3 == 1 else ((first, second), (0, 1))
            separator = "_" if count % 3 == 2 else "/"
            group = file.create_group(separator.join(name.replace("/", "-") for name in names))
            of_first = np.full(len(keypoints[names[0]]), -1, dtype=np.int32)
            of_first[found[:, columns[0]]] = found[:, columns[1]]
            scores = np.where(of_first >= 0, 0.9, 0.0).astype(np.float16)
            group.create_dataset("matches0", data=of_first)
            group.create_dataset("matching_scores0", data=scores)
    lines = [f"{first} {second}\n" for first, second in matches]
    (folder / "pairs.txt").write_text("".join([*lines, "\n", " ".join(reversed(lines[0].split())) + "\n"]))
    return Scene(folder, truth, keypoints, matches)


def by_name(model: pycolmap.Reconstruction) -> dict[str, int]:
    return {image.name: image_id for image_id, image in model.images.items()}


def files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_model_is_the_truth_and_lies_where_hloc_has_it(scene: Scene, tmp_path: Path) -> None:
    before = files(scene.folder)
    model = hloc_mapper.main(**scene.arguments(tmp_path / "sfm"))
    assert files(scene.folder) == before
    ids = by_name(model)
    assert sorted(ids) == sorted(NAMES)
    true_ids = sorted(scene.truth.reg_image_ids())
    errors, _ = colmap_vg.align_positions(centers(model, [ids[n] for n in NAMES]), centers(scene.truth, true_ids))
    assert errors.max() < 0.05  # half a pixel of 1280 at a distance of 7, of 120 points
    assert {path.name for path in (tmp_path / "sfm").iterdir()} == {"database.db", *hloc_mapper.MODEL_FILES}
    written = pycolmap.Reconstruction(tmp_path / "sfm")
    assert written.num_reg_images() == 6
    assert written.num_points3D() == model.num_points3D()


@pytest.mark.parametrize("skip", [True, False])
def test_the_database_holds_the_keypoints_and_matches(scene: Scene, tmp_path: Path, skip: bool) -> None:
    hloc_mapper.main(**scene.arguments(tmp_path, skip_geometric_verification=skip))
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        assert database.num_matched_image_pairs() == len(scene.matches)
        for name in NAMES:
            np.testing.assert_allclose(database.read_keypoints(ids[name])[:, :2], scene.keypoints[name], atol=1e-3)
        for (first, second), matches in scene.matches.items():
            found = database.read_matches(ids[first], ids[second])
            assert {tuple(row) for row in found.tolist()} == {tuple(row) for row in matches.tolist()}
            geometry = database.read_two_view_geometry(ids[first], ids[second])
            assert len(geometry.inlier_matches) >= 0.9 * len(matches)
            assert bool(np.abs(geometry.F if geometry.F is not None else 0.0).max() > 0) != skip


def test_weak_matches_are_left_out(scene: Scene, tmp_path: Path) -> None:
    weak = tmp_path / "matches.h5"
    weak.write_bytes((scene.folder / "matches.h5").read_bytes())
    dropped = 0
    with h5py.File(weak, "r+") as file:

        def lower(name: str, item: object) -> None:
            nonlocal dropped
            if name.endswith("matching_scores0"):
                matched = np.flatnonzero(item[:] > 0)[:10]
                item[matched] = 0.5
                dropped += len(matched)

        file.visititems(lower)
    hloc_mapper.main(**scene.arguments(tmp_path / "sfm", matches=weak, min_match_score=0.5))
    with pycolmap.Database.open(tmp_path / "sfm" / "database.db") as database:
        assert database.num_matches() == sum(map(len, scene.matches.values())) - dropped


def test_an_earlier_result_is_replaced_only_by_a_new_one(scene: Scene, tmp_path: Path) -> None:
    hloc_mapper.main(**scene.arguments(tmp_path))
    (tmp_path / "models" / "1").mkdir(parents=True)
    (tmp_path / "models" / "1" / "images.bin").write_bytes(b"of an earlier job")
    (tmp_path / "notes.txt").write_text("mine")
    before = files(tmp_path)
    few = tmp_path.parent / "few.txt"
    few.write_text(f"{NAMES[1]} {NAMES[0]}\n")
    with pytest.raises(ColmapVgError):
        hloc_mapper.main(**scene.arguments(tmp_path, pairs=few))
    assert files(tmp_path) == before
    hloc_mapper.main(**scene.arguments(tmp_path, image_list=NAMES[:5], pairs=pairs_of(NAMES[:5], tmp_path.parent)))
    assert pycolmap.Reconstruction(tmp_path).num_reg_images() == 5
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "models" / "1").exists()


def pairs_of(names: list[str], folder: Path) -> Path:
    path = folder / "some_pairs.txt"
    path.write_text("".join(f"{a} {b}\n" for i, a in enumerate(names) for b in names[:i]))
    return path


def test_what_is_missing_is_named(scene: Scene, tmp_path: Path) -> None:
    def refused(kind: type[ColmapVgError], words: str, **changed: Any) -> None:
        with pytest.raises(kind, match=words):
            hloc_mapper.main(**scene.arguments(tmp_path / "a" / "sfm", **changed))
        assert not (tmp_path / "a").exists()

    def listed(text: str) -> Path:
        (tmp_path / "pairs.txt").write_text(text)
        return tmp_path / "pairs.txt"

    with h5py.File(tmp_path / "partial.h5", "w") as file, h5py.File(scene.folder / "features.h5") as whole:
        for name in NAMES[:-1]:
            file[f"{name}/keypoints"] = whole[f"{name}/keypoints"][:20]
    (tmp_path / "empty").mkdir()
    refused(DataFileError, "none.h5 does not exist", features=tmp_path / "none.h5")
    refused(DataFileError, "not an HDF5 file", features=scene.folder / "pairs.txt")
    refused(DataFileError, f"no keypoints of {NAMES[-1]}", features=tmp_path / "partial.h5")
    refused(
        DataFileError, "does not exist: match", features=tmp_path / "partial.h5", image_list=NAMES[:-1],
        pairs=pairs_of(NAMES[:-1], tmp_path),
    )  # fmt: skip
    refused(DataFileError, "no matches of", matches=tmp_path / "partial.h5")
    refused(DataFileError, "line 2", pairs=listed("a b\na b c\n"))
    refused(DataFileError, "names x.jpg", pairs=listed(f"{NAMES[0]} x.jpg\n"))
    refused(DataFileError, "list of pairs is empty", pairs=listed("\n"))
    refused(ImageFolderError, "is empty", image_dir=tmp_path / "empty")
    refused(OptionError, "num_threads", mapper_options={"num_threads": -2})
    refused(OptionError, "image_options", image_options={"camera_modell": "PINHOLE"})


def test_options_of_hlocs_mapper(capsys: pytest.CaptureFixture[str]) -> None:
    given = {"ba_refine_focal_length": False, "min_num_matches": 20, "init_min_tri_angle": 4}
    options, ignored = hloc_mapper.mapping_options(given)
    assert not options.ba_refine_focal_length
    assert options.read.min_num_inliers == 20
    assert ignored == ["init_min_tri_angle"]
    own = colmap_vg.MappingOptions(num_threads=2)
    assert hloc_mapper.mapping_options(own) == (own, [])


def test_the_arguments_are_hlocs() -> None:
    parameters = inspect.signature(hloc_mapper.main).parameters
    assert list(parameters) == [
        "sfm_dir", "image_dir", "pairs", "features", "matches", "camera_mode", "verbose", "skip_geometric_verification",
        "min_match_score", "image_list", "image_options", "mapper_options",
    ]  # fmt: skip
    assert all(p.default is inspect.Parameter.empty for p in list(parameters.values())[:5])


def test_without_h5py_the_error_says_what_to_install(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ColmapVgError, match="pip install h5py"):
        hloc_mapper.main(**scene.arguments(tmp_path / "sfm"))
    assert not (tmp_path / "sfm").exists()


def test_the_command_line(scene: Scene, tmp_path: Path) -> None:
    given = scene.arguments(tmp_path / "sfm")
    words = [f"--{name}={given[name]}" for name in ("sfm_dir", "image_dir", "pairs", "features", "matches")]
    options = ["--camera_mode", "SINGLE", "--image_options", *(f"{key}={value}" for key, value in CAMERA.items())]
    command = [sys.executable, "-W", "error", str(ROOT / "pipelines" / "hloc_mapper.py")]
    done = subprocess.run([*command, *words, *options, "--verbose"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "solve: All 6 images are registered" in done.stdout
    bad = subprocess.run([*command, *words, "--image_options", "x"], capture_output=True, text=True, timeout=60)
    assert (bad.returncode, bad.stderr) == (1, "error: expected key=value, found 'x'\n")
