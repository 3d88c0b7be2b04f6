"""Paint the texture image of a scene, with a separate region per face: octaves of noise, mortar and stains."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.demo.scene import Scene

Array = NDArray[np.float64]

_WIDTH = 4096  # texels
_MARGIN = 2  # texels between faces
_COLORS = np.array([[112, 118, 96], [128, 84, 66], [138, 134, 124], [176, 164, 142]], dtype=np.float32)  # RGB
_CONTRASTS = np.array([34.0, 26.0, 30.0, 22.0], dtype=np.float32)  # grey values, per material
_BRICK = 1


@dataclass(frozen=True, eq=False)
class TexturedScene:
    """A scene with its texture image and the mapping from faces to it.

    Attributes
    ----------
    scene : Scene
    texture : (h, w, 3) uint8 array
        RGB.
    origins : (q, 2) array
        Texel of each face's first corner.
    axes : (q, 2, 3) array
        A point x of face q has texel ``origins[q] + axes[q] @ (x - quads[q, 0])``; texels per metre.
    """

    scene: Scene
    texture: NDArray[np.uint8]
    origins: Array
    axes: Array


def paint(scene: Scene, rng: np.random.Generator, texels_per_metre: float = 300.0) -> TexturedScene:
    """Pack the faces of a scene into a texture image and paint them."""
    quads, normals = scene.quads, scene.normals()
    along = quads[:, 1] - quads[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    axes = texels_per_metre * np.stack([along, np.cross(normals, along)], axis=1)
    corners = np.einsum("qab,qkb->qka", axes, quads - quads[:, :1])
    low = corners.min(axis=1)
    sizes = np.ceil(corners.max(axis=1) - low).astype(int) + 2 * _MARGIN
    places, height = _packed(sizes)
    texture = _painted(scene, places, sizes, height, rng)
    return TexturedScene(scene, texture, places - low + _MARGIN, axes)


def _packed(sizes: NDArray[np.int_]) -> tuple[NDArray[np.int_], int]:
    """Pack rectangles on shelves of one width, tallest first: their corners (q, 2) and the total height, texels."""
    places = np.zeros_like(sizes)
    x = y = shelf = 0
    for k in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[k, 0] > _WIDTH:
            x, y, shelf = 0, y + shelf, 0
        places[k] = x, y
        x, shelf = x + sizes[k, 0], max(shelf, sizes[k, 1])
    return places, int(y + shelf)


def _painted(
    scene: Scene, places: NDArray[np.int_], sizes: NDArray[np.int_], height: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    detail = _octaves(height, (2, 4, 8, 16, 32), rng)
    stains = _octaves(height, (24, 48, 96, 192), rng)
    tint = np.stack([_octaves(height, (64, 128), rng) for _ in range(3)], axis=2)
    texture = np.zeros((height, _WIDTH, 3), dtype=np.float32)
    for (x, y), (w, h), material in zip(places, sizes, scene.materials, strict=True):
        part = (slice(y, y + h), slice(x, x + w))
        shade = _CONTRASTS[material] * (detail[part] + 0.8 * stains[part])
        texture[part] = _COLORS[material] + shade[..., None] + 9.0 * tint[part]
        if material == _BRICK:
            texture[part] = np.where(_mortar(int(h), int(w))[..., None], texture[part] * 0.4 + 105.0, texture[part])
    return np.clip(texture, 0, 255).astype(np.uint8)


def _octaves(height: int, wavelengths: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Noise of unit standard deviation over the whole texture, with equal parts of each wavelength (texels)."""
    import cv2

    total = np.zeros((height, _WIDTH), dtype=np.float32)
    for wavelength in wavelengths:
        shape = (height // wavelength + 2, _WIDTH // wavelength + 2)
        coarse = rng.standard_normal(shape, dtype=np.float32)
        total += cv2.resize(coarse, (_WIDTH, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(total / total.std())


def _mortar(height: int, width: int) -> NDArray[np.bool_]:
    """Mask (h, w) of the mortar joints of a running bond: courses of 28 texels, bricks of 80."""
    row, column = np.mgrid[:height, :width]
    shifted = column + 40 * (row // 28 % 2)
    return np.asarray((row % 28 < 3) | (shifted % 80 < 3))
