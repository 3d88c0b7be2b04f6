"""How time grows with the size of a problem: synthetic databases and graphs, and the exponents fitted to them."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from paper.markdown import markdown_table

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
    """Seconds of the default solve without matches: robust rotations, gate, CLS and 2O."""
    start = time.perf_counter()
    solve_view_graph(graph, SolveOptions(method="2O"))
    return time.perf_counter() - start


def timed_rotation_averaging(graph: ViewGraph) -> float:
    """Seconds of ``pycolmap.run_rotation_averaging`` alone on the same relative rotations."""
    reconstruction, pose_graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1000, height=1000, params=[1000, 500, 500], camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for image_id in graph.image_ids.tolist():
        image = pycolmap.Image(name=f"{image_id}.jpg", camera_id=1, image_id=image_id)
        reconstruction.add_image_with_trivial_frame(image)
    counts = np.full(graph.num_edges, 100) if graph.num_inliers is None else graph.num_inliers
    seen: set[tuple[int, int]] = set()
    for (i, j), R, count in zip(
        graph.image_ids[graph.edges].tolist(), graph.cam2_from_cam1_rotations, counts.tolist(), strict=True
    ):
        if (min(i, j), max(i, j)) in seen:  # it takes no second edge between two images
            continue
        seen.add((min(i, j), max(i, j)))
        edge = pycolmap.PoseGraphEdge()
        edge.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(R), np.zeros(3))
        edge.num_matches = count
        pose_graph.add_edge(i, j, edge)
    start = time.perf_counter()
    pycolmap.run_rotation_averaging(pycolmap.RotationEstimatorOptions(), pose_graph, reconstruction, [])
    return time.perf_counter() - start
