"""COLMAP's own formats and PLY files."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from exported_models import make_model

from colmap_vg.errors import MappingError
from colmap_vg.exports.colmap_files import write_binary, write_ply, write_text
from colmap_vg.exports.source import find_source


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_models_are_read_as_they_were(tmp_path: Path, write: object) -> None:
    names = ["a/x.jpg", "b/x.jpg", "\"q\" 'é'\u2028".replace(" ", "_")]
    before = make_model(tmp_path / "model", ("OPENCV",), names)
    (tmp_path / "out").mkdir()
    write(find_source(tmp_path / "model"), tmp_path / "out")  # type: ignore[operator]
    after = pycolmap.Reconstruction(tmp_path / "out")
    assert {i: image.name for i, image in after.images.items()} == dict(zip(sorted(after.images), names, strict=True))
    for image_id, image in before.images.items():
        np.testing.assert_allclose(
            after.image(image_id).cam_from_world().matrix(), image.cam_from_world().matrix(), atol=1e-12
        )
    assert after.num_points3D() == before.num_points3D()
    endings = {path.suffix for path in (tmp_path / "out").iterdir()}
    assert endings == {".txt" if write is write_text else ".bin"}


@pytest.mark.parametrize("name", ["a b.jpg", "two\nlines.jpg", " a.jpg"])
def test_the_text_format_refuses_names_that_it_would_cut(tmp_path: Path, name: str) -> None:
    make_model(tmp_path / "model", names=[name])
    with pytest.raises(MappingError, match="white space: export binary"):
        write_text(find_source(tmp_path / "model"), tmp_path)


def test_the_points_are_in_the_ply_file(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    write_ply(find_source(tmp_path / "model"), tmp_path / "points.ply")
    head, _, data = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 40" in head
    rows = np.frombuffer(data, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    truth = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(np.sort(rows["xyz"], axis=0), np.sort(truth, axis=0), rtol=1e-6)


def test_a_model_without_points_has_no_ply_file(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    model.delete_all_points2D_and_points3D()
    model.write(tmp_path / "model")
    with pytest.raises(MappingError, match="has no points"):
        write_ply(find_source(tmp_path / "model"), tmp_path / "points.ply")
