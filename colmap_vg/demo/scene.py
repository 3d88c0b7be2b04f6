"""Random scene of a ruined courtyard made of planar faces: ground, broken walls, columns, an arch and rubble."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_GROUND, _BRICK, _STONE, _PLASTER = range(4)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene of planar quadrilaterals with materials.

    Attributes
    ----------
    quads : (q, 4, 3) array
        Corners, world frame with z up, metres; counter-clockwise as seen from outside.
    materials : (q,) int64 array
        0: ground, 1: brick, 2: stone, 3: plaster.
    """

    quads: Array
    materials: IntArray

    def normals(self) -> Array:
        """Unit outward normals, (q, 3)."""
        normal = np.cross(self.quads[:, 1] - self.quads[:, 0], self.quads[:, 2] - self.quads[:, 0])
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def build_ruin(rng: np.random.Generator) -> Scene:
    """Build a random scene with a diameter of about four metres."""
    parts = [(_ground(), _GROUND), *_walls(rng), *_columns(rng), *_arch(rng), *_rubble(rng)]
    quads = np.concatenate([quads for quads, _ in parts])
    materials = np.concatenate([np.full(len(quads), material) for quads, material in parts])
    return Scene(quads, materials.astype(np.int64))


def _ground() -> Array:
    half = 3.2
    return np.array([[[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]]])


def _walls(rng: np.random.Generator) -> list[tuple[Array, int]]:
    """Two walls at an angle, each of blocks of random height."""
    parts = []
    for start, along, material in (((-1.5, -0.9), (1.0, 0.12), _BRICK), ((-1.35, -0.65), (-0.1, 1.0), _STONE)):
        direction = np.array(along) / np.hypot(*along)
        yaw = float(np.arctan2(direction[1], direction[0]))
        place = np.array(start)
        for _ in range(5):
            length, height = rng.uniform(0.35, 0.6), rng.uniform(0.5, 1.5)
            center = place + direction * length / 2
            parts.append((_box((center[0], center[1], height / 2), (length, 0.22, height), yaw), material))
            place = place + direction * length
    return parts


def _columns(rng: np.random.Generator) -> list[tuple[Array, int]]:
    parts = []
    for x, y in ((0.5, 0.9), (1.15, 0.5), (1.3, -0.25)):
        height = rng.uniform(0.5, 1.4)
        parts.append((_box((x, y, 0.06), (0.42, 0.42, 0.12), rng.uniform(0, 1)), _STONE))
        parts.append((_prism((x, y, 0.12), 0.15, height, 12), _PLASTER))
    return parts


def _arch(rng: np.random.Generator) -> list[tuple[Array, int]]:
    """Two pillars and the arch of stones above them."""
    yaw, radius = rng.uniform(-0.3, 0.3), 0.4
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    middle = np.array([0.1, -0.15, 0.0])
    parts = []
    for side in (-1.0, 1.0):
        foot = middle + turn @ np.array([side * radius, 0.0, 0.35])
        parts.append((_box(tuple(foot), (0.22, 0.26, 0.7), yaw), _STONE))
    for angle in np.linspace(0.12, np.pi - 0.12, 7):
        stone = _box((0.0, 0.0, 0.0), (0.24, 0.26, 0.17), 0.0)
        lean = np.array([[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]])
        place = np.array([radius * np.cos(angle), 0.0, 0.7 + radius * np.sin(angle)])
        parts.append(((stone @ lean.T + place) @ turn.T + middle, _STONE))
    return parts


def _rubble(rng: np.random.Generator) -> list[tuple[Array, int]]:
    parts = []
    for _ in range(22):
        x, y = rng.uniform(-1.9, 1.9, 2)
        size = rng.uniform(0.08, 0.32, 3)
        box = _box((0.0, 0.0, 0.0), tuple(size), rng.uniform(0, np.pi))
        tilt = rng.uniform(-0.35, 0.35)
        lean = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
        parts.append((box @ lean.T + np.array([x, y, 0.4 * size[2]]), int(rng.integers(_BRICK, _PLASTER + 1))))
    return parts


def _box(center: tuple[float, ...], size: tuple[float, ...], yaw: float) -> Array:
    """Faces of a box that is rotated about the vertical axis, (6, 4, 3)."""
    corner = np.array(
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    )
    faces = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((corner * np.array(size) / 2 @ turn.T + np.array(center))[faces])


def _prism(foot: tuple[float, ...], radius: float, height: float, num_sides: int) -> Array:
    """Faces of the sides and the top of an upright prism with an even number of sides, (q, 4, 3)."""
    angle = 2 * np.pi * np.arange(num_sides) / num_sides
    low = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(num_sides)], axis=1) + np.array(foot)
    high = low + np.array([0.0, 0.0, height])
    after = np.roll(np.arange(num_sides), -1)
    sides = np.stack([low, low[after], high[after], high], axis=1)
    top = np.stack([[high[0], high[k], high[k + 1], high[k + 2]] for k in range(1, num_sides - 2, 2)])
    return np.concatenate([sides, top])
