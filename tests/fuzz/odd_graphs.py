"""Random viewing graphs, sound and broken: a seed gives the arguments of a `ViewGraph` and of `SolveOptions`."""

from contextlib import suppress
from typing import Any, get_args

import numpy as np

from colmap_vg.options import Method

Generator = np.random.Generator
Fields = dict[str, Any]

ODD_FLOATS = (np.nan, np.inf, -np.inf, 0.0, 1e-310, 1e-12, 1e20, 1e300, -1.0)
SHAPES = ("empty", "single", "pair", "tree", "cycle", "star", "complete", "random", "disconnected", "large", "bridge")


def odd_case(seed: int) -> tuple[Fields, Fields, list[str]]:
    """Arguments of the graph and of the options, and what is odd about them."""
    rng = np.random.default_rng(seed)
    shape, places = str(rng.choice(SHAPES)), str(rng.choice(["free", "free", "line", "plane", "one point", "twins"]))
    n, edges = _edges(shape, rng)
    fields = _graph(n, edges, _places(places, n, rng), float(rng.choice([0.0, 0.01, 0.1, 3.0])), rng)
    if rng.random() < 0.5:
        _add_cameras(fields, rng)
    if rng.random() < 0.4:
        _add_matches(fields, rng)
    if rng.random() < 0.3:
        _add_information(fields, rng)
    odd = [shape, places]
    for _ in range(int(rng.choice([0, 0, 1, 1, 2]))):
        fault = FAULTS[int(rng.integers(len(FAULTS)))]
        odd.append(fault.__name__)
        with suppress(AttributeError, TypeError, ValueError, IndexError):  # another fault took the array away
            fault(fields, rng)
    options = {
        "method": str(rng.choice(get_args(Method))),
        "rotation_averaging": str(rng.choice(["robust", "chordal"])),
        "outlier_filter": str(rng.choice(["robust", "1dsfm", "none"])),
        "edge_weights": str(rng.choice(["information", "inliers", "unit"])),
        "rotation_gate_deg": float(rng.choice([0.0, 10.0, 180.0])),
        "direction_gate_deg": float(rng.choice([0.0, 15.0])),
        "max_num_iterations": int(rng.choice([1, 100])),
    }
    return fields, options, odd


def _edges(shape: str, rng: Generator) -> tuple[int, np.ndarray]:
    n = {"empty": int(rng.integers(0, 4)), "single": 1, "pair": 2, "large": 150}.get(shape, int(rng.integers(3, 12)))
    every = np.stack(np.triu_indices(n, 1), axis=1)
    if shape in ("empty", "single"):
        return n, np.zeros((0, 2), dtype=np.int64)
    if shape == "tree":
        return n, np.stack([[int(rng.integers(0, k)) for k in range(1, n)], np.arange(1, n)], axis=1)
    if shape == "cycle":
        return n, np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    if shape == "star":
        return n, np.stack([np.zeros(n - 1, dtype=int), np.arange(1, n)], axis=1)
    if shape == "disconnected":
        return n, every[(every[:, 0] < n // 2) == (every[:, 1] < n // 2)]
    if shape == "bridge":
        inside = (every[:, 0] < n // 2) == (every[:, 1] < n // 2)
        return n, every[inside | ((every[:, 0] == 0) & (every[:, 1] == n - 1))]
    if shape == "complete":
        return n, every
    chosen = every[rng.random(len(every)) < (0.1 if shape == "large" else rng.uniform(0.2, 1.0))]
    flipped = rng.random(len(chosen)) < 0.5
    return n, np.where(flipped[:, None], chosen[:, ::-1], chosen)


def _places(places: str, n: int, rng: Generator) -> np.ndarray:
    centers = rng.normal(size=(n, 3))
    if places == "line":
        return centers[:, :1] * np.array([1.0, 2.0, -1.0])
    if places == "plane":
        return centers * np.array([1.0, 1.0, 0.0])
    if places == "one point":
        return np.zeros((n, 3))
    if places == "twins":
        return centers[np.arange(n) // 2]
    return centers


def _rotations(n: int, angle: float, rng: Generator) -> np.ndarray:
    quaternion = np.concatenate([np.ones((n, 1)), angle * rng.normal(size=(n, 3))], axis=1)
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0).reshape(n, 3, 3)


def _unit(v: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(norm > 0, v / np.where(norm > 0, norm, 1.0), np.array([0.0, 0.0, 1.0]))


def _graph(n: int, edges: np.ndarray, centers: np.ndarray, noise: float, rng: Generator) -> Fields:
    i, j = edges.T if len(edges) else (np.zeros(0, dtype=int), np.zeros(0, dtype=int))
    R = _rotations(n, 1.0, rng)
    relative = _rotations(len(edges), noise, rng) @ R[j] @ np.swapaxes(R[i], 1, 2)
    directions = np.einsum("kab,kb->ka", R[i], centers[j] - centers[i]) + noise * rng.normal(size=(len(edges), 3))
    return {
        "image_ids": rng.permutation(np.arange(n)) * int(rng.choice([1, 7])) + 1,
        "edges": edges,
        "cam2_from_cam1_rotations": relative,
        "cam2_in_cam1_directions": _unit(directions),
        "num_inliers": rng.integers(0, 500, len(edges)) if rng.random() < 0.7 else None,
        "_true": (R, centers),
    }


def _add_cameras(fields: Fields, rng: Generator) -> None:
    n = len(fields["image_ids"])
    c = max(1, n // 2)
    fields["camera_idx"] = rng.integers(0, c, n)
    fields["camera_ids"] = np.arange(c) + 1
    fields["camera_focal_lengths"] = rng.uniform(500, 2000, c)
    fields["camera_focal_known"] = rng.random(c) < 0.5


def _add_matches(fields: Fields, rng: Generator) -> None:
    R, centers = fields["_true"]
    edges = fields["edges"]
    counts = rng.integers(0, 40, len(edges))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    edge = np.repeat(np.arange(len(edges)), counts)
    points = 5.0 * rng.normal(size=(len(edge), 3)) if rng.random() < 0.8 else np.zeros((len(edge), 3))
    if len(edge) == 0:
        bearings = [np.zeros((0, 3)), np.zeros((0, 3))]
    else:
        bearings = [
            _unit(np.einsum("kab,kb->ka", R[edges[edge, s]], points - centers[edges[edge, s]])) for s in range(2)
        ]
    fields["inlier_offsets"], fields["num_inliers"] = offsets, counts
    fields["inlier_bearings1"], fields["inlier_bearings2"] = bearings
    if rng.random() < 0.5:
        fields["inlier_keypoints1"] = rng.integers(0, 50, len(edge)).astype(np.int32)
        fields["inlier_keypoints2"] = rng.integers(0, 50, len(edge)).astype(np.int32)


def _add_information(fields: Fields, rng: Generator) -> None:
    m = len(fields["edges"])
    A = rng.normal(size=(m, 5, 5)) * float(rng.choice([1e-6, 1.0, 1e6]))
    fields["edge_information"] = A @ np.swapaxes(A, 1, 2)


# Faults


def self_loop(fields: Fields, rng: Generator) -> None:
    if len(fields["edges"]):
        fields["edges"] = fields["edges"].copy()
        fields["edges"][0, 1] = fields["edges"][0, 0]


def edge_twice(fields: Fields, rng: Generator) -> None:
    """Every array of edges gets its first row again, or all of them, turned or not."""
    m = len(fields["edges"])
    if m == 0 or "inlier_offsets" in fields:
        return
    rows = np.concatenate([np.arange(m), np.arange(m) if rng.random() < 0.5 else [0]])
    for name in ("edges", "cam2_from_cam1_rotations", "cam2_in_cam1_directions", "num_inliers", "edge_information"):
        if fields.get(name) is not None:
            fields[name] = fields[name][rows]


def row_outside(fields: Fields, rng: Generator) -> None:
    if len(fields["edges"]):
        fields["edges"] = fields["edges"].copy()
        fields["edges"][-1, int(rng.integers(2))] = int(rng.choice([-1, len(fields["image_ids"]), 2**40]))


def odd_rotation(fields: Fields, rng: Generator) -> None:
    R = fields["cam2_from_cam1_rotations"].copy()
    if len(R):
        kind, k = int(rng.integers(5)), int(rng.integers(len(R)))
        R[k] = [
            np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3), np.eye(3) + 1e-3 * rng.normal(size=(3, 3)),
            np.diag([1e200, 1.0, 1e-200]),
        ][kind]  # fmt: skip
    fields["cam2_from_cam1_rotations"] = R


def odd_direction(fields: Fields, rng: Generator) -> None:
    g = fields["cam2_in_cam1_directions"].copy()
    if len(g):
        g[int(rng.integers(len(g)))] *= float(rng.choice(ODD_FLOATS))
    fields["cam2_in_cam1_directions"] = g


def random_directions(fields: Fields, rng: Generator) -> None:
    fields["cam2_in_cam1_directions"] = _unit(rng.normal(size=fields["cam2_in_cam1_directions"].shape))


def same_directions(fields: Fields, rng: Generator) -> None:
    fields["cam2_in_cam1_directions"] = np.tile([0.0, 0.0, 1.0], (len(fields["edges"]), 1))


def half_turns(fields: Fields, rng: Generator) -> None:
    """Relative rotations by 180 degrees, where logarithms are least sure."""
    turn = np.diag([1.0, -1.0, -1.0])
    some = rng.random(len(fields["edges"])) < rng.choice([0.3, 1.0])
    fields["cam2_from_cam1_rotations"] = np.where(some[:, None, None], turn, fields["cam2_from_cam1_rotations"])


def odd_numbers(fields: Fields, rng: Generator) -> None:
    """One odd value in one array of floats."""
    names = [k for k, v in fields.items() if isinstance(v, np.ndarray) and v.dtype.kind == "f" and v.size]
    if names:
        name = str(rng.choice(names))
        fields[name] = fields[name].copy()
        fields[name].flat[int(rng.integers(fields[name].size))] = float(rng.choice(ODD_FLOATS))


def odd_integers(fields: Fields, rng: Generator) -> None:
    names = [k for k, v in fields.items() if isinstance(v, np.ndarray) and v.dtype.kind in "iu" and v.size]
    if names:
        name = str(rng.choice(names))
        fields[name] = fields[name].astype(np.int64)
        fields[name].flat[int(rng.integers(fields[name].size))] = int(rng.choice([-1, 0, 10**6, 2**31, 2**62]))


def wrong_shape(fields: Fields, rng: Generator) -> None:
    names = [k for k, v in fields.items() if isinstance(v, np.ndarray)]
    name, kind = str(rng.choice(names)), int(rng.integers(4))
    value = fields[name]
    fields[name] = [value[:-1], value.ravel(), value[None], np.concatenate([value, value[:1]])][kind]


def wrong_type(fields: Fields, rng: Generator) -> None:
    names = [k for k, v in fields.items() if isinstance(v, np.ndarray)]
    name, kind = str(rng.choice(names)), int(rng.integers(5))
    value = fields[name]
    fields[name] = [value.astype(str), value.astype(object), value.astype(complex), value.tolist(), "text"][kind]


def missing(fields: Fields, rng: Generator) -> None:
    names = [k for k in fields if k not in ("image_ids", "edges", "_true")]
    fields[str(rng.choice(names))] = None


def odd_verdicts(fields: Fields, rng: Generator) -> None:
    words = ["kept", "rotation_only", "uncalibrated", "no_pose", "degenerate", "few_inliers", "nonsense", ""]
    fields["read_verdicts"] = rng.choice(words[: int(rng.integers(1, 9))], size=len(fields["edges"]))


def odd_inliers(fields: Fields, rng: Generator) -> None:
    fields["num_inliers"] = rng.choice([-5, 0, 1, 2**40], size=len(fields["edges"]))


def odd_angles(fields: Fields, rng: Generator) -> None:
    fields["triangulation_angles"] = rng.choice([0.0, np.nan, -1.0, np.inf, 0.5], size=len(fields["edges"]))
    fields["planar"] = rng.random(len(fields["edges"])) < 0.5


FAULTS = (
    self_loop, edge_twice, row_outside, odd_rotation, odd_direction, random_directions, same_directions, half_turns,
    odd_numbers, odd_integers, wrong_shape, wrong_type, missing, odd_verdicts, odd_inliers, odd_angles,
)  # fmt: skip
