"""Trajectories in the TUM format: a line ``timestamp tx ty tz qx qy qz qw`` per image, camera to world."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from colmap_vg.exports.source import Source, world_from_cam

_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def write_tum(source: Source, path: Path) -> list[str]:
    """Write a line per image, in the order of the timestamps.

    Returns
    -------
    list of str
        A note on what the timestamps are.
    """
    images = source.images()
    stamps = timestamps([image.name for image in images])
    note = "timestamps are the numbers in the images' names"
    if stamps is None:
        stamps, note = list(map(str, range(len(images)))), "timestamps are the places of the images in order of name"
    lines = []
    for stamp, image in sorted(zip(stamps, images, strict=True), key=lambda row: float(row[0])):
        quaternion, center = world_from_cam(image)
        lines.append(" ".join([stamp, *map(repr, [*center.tolist(), *quaternion.tolist()])]))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return [note]


def timestamps(names: Sequence[str]) -> list[str] | None:
    """Return the number in each file name as it is written; None unless each has one number, and all are distinct.

    >>> timestamps(["rgb/1305031102.175304.png", "rgb/1305031102.211214.png"])
    ['1305031102.175304', '1305031102.211214']
    >>> timestamps(["20200101_120000.jpg", "20200101_120001.jpg"])
    """
    found = [_NUMBER.findall(PurePosixPath(name).stem) for name in names]
    if any(len(numbers) != 1 for numbers in found):
        return None
    stamps = [str(numbers[0]) for numbers in found]
    return stamps if len({float(stamp) for stamp in stamps}) == len(stamps) else None
