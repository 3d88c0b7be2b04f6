"""Small copies of photographs."""

from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_vg.report.thumbnails import thumbnails


def pixels(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(b64decode(data), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize(("size", "shape"), [((3000, 2000), (64, 96)), ((100, 200), (96, 48)), ((30, 20), (20, 30))])
def test_the_longer_side_is_at_most_that_asked_for(
    tmp_path: Path, size: tuple[int, int], shape: tuple[int, int]
) -> None:
    photograph = np.full((size[1], size[0], 3), (20, 120, 220), np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), photograph)
    (small,) = thumbnails(tmp_path, ["a.jpg"], [96])
    assert pixels(small).shape == (*shape, 3)
    np.testing.assert_allclose(pixels(small).mean(axis=(0, 1)), (20, 120, 220), atol=4)


def test_what_cannot_be_read_is_left_empty(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no photograph")
    (tmp_path / "empty.jpg").write_bytes(b"")
    names = ["text.jpg", "empty.jpg", "missing.jpg", "zero\0.jpg", ".", "x" * 300]
    assert thumbnails(tmp_path, names, [96] * len(names)) == [""] * len(names)
