"""Photographs for tests: a textured corner of a room, ray-cast from known cameras, and JPEG files with EXIF tags."""

import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL_LENGTH = 480, 360, 450.0


@dataclass(frozen=True)
class Corner:
    """Photographs of the corner, and the centres (n, 3) that they were taken from."""

    images: list[NDArray[np.uint8]]
    centers: NDArray[np.float64]

    def write(self, folder: Path, suffix: str = ".jpg") -> None:
        """Write the photographs as 00.jpg, 01.jpg, ..."""
        folder.mkdir(parents=True, exist_ok=True)
        for index, image in enumerate(self.images):
            path = folder / f"{index:02d}{suffix}"
            if suffix == ".jpg":
                write_jpeg(path, image)
            else:
                cv2.imwrite(str(path), image)


def render_corner(num_images: int, seed: int = 0) -> Corner:
    """Ray-cast the planes x = 0, y = 0 and z = 0, each with its own noise texture, from an arc around (1, 1, 1)."""
    random = np.random.default_rng(seed)
    textures = [_texture(random) for _ in range(3)]
    angles = np.radians(np.linspace(20.0, 70.0, num_images))
    heights = 2.2 + 0.5 * np.cos(3.0 * angles)
    centers = np.stack([4.5 * np.cos(angles), 4.5 * np.sin(angles), heights], axis=1)
    images = [_photograph(center, textures) for center in centers]
    return Corner(images, centers)


def write_jpeg(
    path: Path, image: NDArray[np.uint8], orientation: int | None = None, focal_35mm: int | None = None
) -> None:
    """Write a JPEG file with the EXIF tags given."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    tags = _exif(orientation, focal_35mm) if orientation is not None or focal_35mm is not None else b""
    path.write_bytes(data[:2] + tags + data[2:])


def _texture(random: np.random.Generator, size: int = 2048) -> NDArray[np.uint8]:
    texture = np.zeros((size, size, 3))
    for cells, weight in ((16, 0.25), (64, 0.3), (160, 0.45)):
        noise = random.uniform(0.0, 255.0, (cells, cells, 3))
        texture += weight * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(2.0 * (texture - 127.5) + 127.5, 0, 255).astype(np.uint8)


def _photograph(center: NDArray[np.float64], textures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    forward = np.array([0.8, 0.8, 0.9]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = (
        ((columns - WIDTH / 2) / FOCAL_LENGTH)[..., None] * right
        + ((rows - HEIGHT / 2) / FOCAL_LENGTH)[..., None] * down
        + forward
    )
    with np.errstate(divide="ignore"):
        depths = -center / rays
    depths[depths <= 0.0] = np.inf
    plane = np.argmin(depths, axis=-1)
    points = center + rays * np.take_along_axis(depths, plane[..., None], axis=-1)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for axis, texture in enumerate(textures):
        u, v = (points[..., other].astype(np.float32) * 400.0 for other in range(3) if other != axis)
        drawn = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        image[plane == axis] = drawn[plane == axis]
    return image


def _exif(orientation: int | None, focal_35mm: int | None) -> bytes:
    """An APP1 segment with the tags Orientation (0x0112) and FocalLengthIn35mmFilm (0xA405, in the EXIF directory)."""
    entries = []
    if orientation is not None:
        entries.append(struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0))
    if focal_35mm is not None:
        start = 8 + 2 + 12 * (len(entries) + 1) + 4
        entries.append(struct.pack("<HHII", 0x8769, 4, 1, start))
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + struct.pack("<I", 0)
    if focal_35mm is not None:
        directory += struct.pack("<H", 1) + struct.pack("<HHIHH", 0xA405, 3, 1, focal_35mm, 0) + struct.pack("<I", 0)
    payload = b"Exif\0\0" + b"II*\0" + struct.pack("<I", 8) + directory
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload
