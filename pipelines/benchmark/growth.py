"""How time grows with the size of a problem: synthetic databases and graphs, and the exponents fitted to them."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from paper.markdown import markdown_table

from benchmark.rotation_averaging import averaged_by_pycolmap
from colmap_vg.options import SolveOptions
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import SyntheticScene, ring_cameras, scene_from_poses
from colmap_vg.solver.solve import solve_view_graph


@dataclass(frozen=True)
class Timing:
    """Seconds that something of a size took."""

    name: str
    size: int
    seconds: float


def fitted_exponent(timings: Sequence[Timing]) -> float:
    """Slope of a least-squares line through the logarithms of sizes and seconds; NaN for fewer than two sizes."""
    sizes, seconds = np.array([t.size for t in timings]), np.array([t.seconds for t in timings])
    if len(np.unique(sizes)) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def growth_table(timings: Mapping[str, Sequence[Timing]], unit: str) -> str:
    """Markdown: one line a series, with its exponent."""
    rows = [
        [name, ", ".join(f"{t.size}: {t.seconds:.2f}" for t in series), f"{fitted_exponent(series):.2f}"]
        for name, series in timings.items()
    ]
    return markdown_table(["series", f"seconds by {unit}", "exponent"], rows)


def looped_scene(num_images: int, num_edges: int, *, long_share: float = 0.01, seed: int = 0) -> SyntheticScene:
    """A ring of cameras with edges to the next ones, and a share of edges anywhere: loops cost solvers most."""
    rng = np.random.default_rng(seed)
    R, p = ring_cameras(num_images, rng, radius=4.0)
    reach = max(num_edges // num_images, 1)
    first = np.repeat(np.arange(num_images), reach)
    second = (first + np.tile(np.arange(1, reach + 1), num_images)) % num_images
    anywhere = rng.random(len(first)) < long_share
    second[anywhere] = rng.integers(num_images, size=int(anywhere.sum()))
    edges = np.sort(np.stack([first, second], axis=1)[first != second], axis=1)
    edges = np.unique(edges, axis=0).astype(np.int64)
    return scene_from_poses(R, p, edges, rotation_sigma=0.01, direction_sigma=0.02, outlier_share=0.05, rng=rng)


def timed_solve(graph: ViewGraph) -> float:
    """Seconds of solving by 2O: robust rotations, gate, CLS and 2O."""
    start = time.perf_counter()
    solve_view_graph(graph, SolveOptions(method="2O"))
    return time.perf_counter() - start


def timed_rotation_averaging(graph: ViewGraph) -> float:
    """Seconds of ``pycolmap.run_rotation_averaging`` alone on the same relative rotations."""
    return averaged_by_pycolmap(graph)[1]
