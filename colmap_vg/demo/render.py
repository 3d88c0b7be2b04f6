"""Render photographs by ray casting on the CPU, with lens distortion, sunlight, vignetting, exposure and noise."""

import ctypes
from types import ModuleType
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.demo.texture import TexturedScene
from colmap_vg.errors import ColmapVgError

Array = NDArray[np.float64]

SAMPLES = 2  # rays per pixel in each direction
_SUN = np.array([0.45, -0.35, 0.82])  # direction to the sun, world frame
_SKY = np.array([186.0, 203.0, 226.0], dtype=np.float32)  # RGB, 0 to 255
_AMBIENT = 0.45  # share of ambient light
_VIGNETTING = 0.35  # share of the light lost per squared tangent of the angle to the optical axis
_READ_NOISE, _SHOT_NOISE = 1.2, 0.05  # standard deviation, grey values; variance per grey value


class RayCaster:
    """Ray caster for a textured scene.

    Parameters
    ----------
    textured : TexturedScene

    Raises
    ------
    ColmapVgError
        open3d cannot be loaded.
    """

    def __init__(self, textured: TexturedScene) -> None:
        o3d = load_open3d()
        quads = textured.scene.quads
        triangles = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(quads))[:, None, None]
        self._o3d: Any = o3d
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(quads.reshape(-1, 3).astype(np.float32)),
            o3d.core.Tensor(triangles.reshape(-1, 3).astype(np.uint32)),
        )
        self._textured = textured
        self._shades = _AMBIENT + (1.0 - _AMBIENT) * np.clip(textured.scene.normals() @ _SUN, 0.0, None)

    def colors(self, origin: Array, directions: Array) -> NDArray[np.float32]:
        """Colours (h, w, 3), RGB, 0 to 255, seen along rays (h, w, 3) from one point."""
        import cv2

        quad, depth = self.hits(origin, directions)
        seen = quad >= 0
        face = np.where(seen, quad, 0)
        textured = self._textured
        points = origin + np.where(seen, depth, 0.0)[..., None] * directions
        local = points - textured.scene.quads[face, 0]
        texel = textured.origins[face] + np.einsum("hwab,hwb->hwa", textured.axes[face], local)
        colors = cv2.remap(textured.texture, texel.astype(np.float32), None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        lit = colors.astype(np.float32) * self._shades[face].astype(np.float32)[..., None]
        return np.where(seen[..., None], lit, _SKY).astype(np.float32)

    def hits(self, origin: Array, directions: Array) -> tuple[NDArray[np.int64], Array]:
        """Face (h, w) that each ray hits (-1: sky), and its distance (h, w) in units of the direction's length."""
        rays = np.empty((*directions.shape[:2], 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = origin, directions
        found = self._scene.cast_rays(self._o3d.core.Tensor(rays))
        triangle = found["primitive_ids"].numpy().astype(np.int64)
        depth = found["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(depth), triangle // 2, -1), depth


def photograph(
    caster: RayCaster, in_camera: Array, rotation: Array, center: Array, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Render one photograph.

    Parameters
    ----------
    caster : RayCaster
    in_camera : (SAMPLES h, SAMPLES w, 3) array
        Rays of the camera's pixels, camera frame, from `pixel_rays`.
    rotation : (3, 3) array
        cam_from_world.
    center : (3,) array
        Projection centre, world frame, metres.
    rng : numpy.random.Generator
        Generator of exposure and noise.

    Returns
    -------
    (h, w, 3) uint8 array
        BGR.
    """
    light = caster.colors(center, in_camera @ rotation)
    light *= (1.0 - _VIGNETTING * np.sum(in_camera[..., :2] ** 2, axis=2))[..., None].astype(np.float32)
    h, w = in_camera.shape[0] // SAMPLES, in_camera.shape[1] // SAMPLES
    image = light.reshape(h, SAMPLES, w, SAMPLES, 3).mean(axis=(1, 3)) * rng.uniform(0.85, 1.15)
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    image = image + noise * np.sqrt(_READ_NOISE**2 + _SHOT_NOISE * np.maximum(image, 0.0))
    return np.ascontiguousarray(np.clip(np.rint(image[..., ::-1]), 0, 255).astype(np.uint8))


def pixel_rays(camera: "pycolmap.Camera", samples: int = SAMPLES) -> Array:
    """Rays ``(x, y, 1)`` through a grid of samples in each pixel, camera frame, (samples h, samples w, 3)."""
    x = (np.arange(samples * camera.width) + 0.5) / samples
    y = (np.arange(samples * camera.height) + 0.5) / samples
    grid = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    rays = np.ones((len(grid), 3))
    rays[:, :2] = camera.cam_from_img(grid)
    return rays.reshape(len(y), len(x), 3)


def load_open3d() -> ModuleType:
    """Import open3d, after loading the libusb of a Python package, since some machines lack the library.

    Raises
    ------
    ColmapVgError
        open3d cannot be loaded.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        import open3d
    except (ImportError, OSError) as error:
        raise ColmapVgError(
            f"the demo renders with open3d, which cannot be loaded ({error}): install colmap_vg again with pip"
        ) from error
    return open3d
