"""Rotations of simulated object graphs, nearly half of whose pairs are false: ours beside pycolmap's averaging.

    python pipelines/object_graphs.py --num_graphs 100

Prints, by the share of false pairs that agree among themselves, in how many graphs all images come out within three
degrees, in how many some are folded by more than fifteen, and what status the solution has.
"""

import argparse
from collections import Counter

import numpy as np
import pycolmap
from benchmark.rotation_averaging import averaged_by_pycolmap
from numpy.typing import NDArray

from colmap_vg import SolutionStatus, solve_view_graph
from colmap_vg.geometry import so3
from colmap_vg.simulation.objects import ObjectNoise, object_scene
from colmap_vg.simulation.ring_scenes import SyntheticScene

Array = NDArray[np.float64]

RIGHT_DEG, FOLDED_DEG = 3.0, 15.0
COHERENT_SHARES = (0.2, 0.5, 0.9)


def drawn_scene(seed: int) -> tuple[ObjectNoise, SyntheticScene]:
    """A scene of 50 to 150 images and 1,000 to 4,000 pairs; noise and false pairs are drawn with them."""
    rng = np.random.default_rng(1000 + seed)
    num_images = int(rng.integers(50, 151))
    num_edges = max(int(min(rng.integers(1000, 4001), 0.45 * num_images * (num_images - 1))), 1000)
    noise = ObjectNoise(
        hardness=float(rng.choice([0.0, 0.5, 1.0])),
        coherent_share=float(rng.choice(COHERENT_SHARES)),
        focal_error=float(rng.choice([0.0, 0.0, 0.02, -0.02])),
    )
    return noise, object_scene(num_images, num_edges, noise, seed)


def errors_deg(rotations: Array, truth: Array) -> Array:
    """Angles to the truth after the turn of the world that most images agree on, degrees."""
    turns = np.swapaxes(truth, 1, 2) @ rotations
    angles = np.degrees(so3.angle(np.swapaxes(turns[:, None], 2, 3) @ turns[None]))
    return np.asarray(angles[np.argmin(np.median(angles, axis=1))])


def by_pycolmap(scene: SyntheticScene) -> tuple[NDArray[np.int64], Array]:
    """Rows of the images that ``pycolmap.run_rotation_averaging`` registers, and their rotations."""
    graph = scene.graph
    reconstruction, _ = averaged_by_pycolmap(graph)
    ids = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    rotations = [reconstruction.image(i).cam_from_world().rotation.matrix() for i in ids.tolist()]
    return np.searchsorted(graph.image_ids, ids), np.array(rotations).reshape(-1, 3, 3)


def outcome(rows: NDArray[np.int64], rotations: Array, scene: SyntheticScene) -> str:
    """In a word how rotations of some images compare with the truth."""
    if len(rows) == 0:
        return "nothing"
    errors = errors_deg(rotations, scene.cam_from_world_rotations[rows])
    if (errors > FOLDED_DEG).any():
        return "folded"
    return "right" if len(rows) == scene.graph.num_images and (errors <= RIGHT_DEG).all() else "near"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num_graphs", type=int, required=True)
    parser.add_argument("--first_seed", type=int, default=0)
    options = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    found: Counter[tuple[float, str, str]] = Counter()
    for seed in range(options.first_seed, options.first_seed + options.num_graphs):
        noise, scene = drawn_scene(seed)
        solution = solve_view_graph(scene.graph)
        rows = np.flatnonzero(solution.registered)
        word = outcome(rows, solution.cam_from_world_rotations[rows], scene)
        doubt = "doubtful" if solution.status == SolutionStatus.DOUBTFUL else "not doubted"
        found[noise.coherent_share, "ours", f"{word}, {doubt}"] += 1
        found[noise.coherent_share, "pycolmap", outcome(*by_pycolmap(scene), scene)] += 1
    for share in COHERENT_SHARES:
        for who in ("ours", "pycolmap"):
            words = sorted((word, count) for (s, w, word), count in found.items() if (s, w) == (share, who))
            print(f"coherent {share:.0%}, {who}: " + "; ".join(f"{count} {word}" for word, count in words))


if __name__ == "__main__":
    main()
