"""The book kept while a graph is solved: verdicts on images and edges, and the iteration log."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.graph.components import components_by_size
from colmap_vg.graph.rigidity import largest_rigid_component
from colmap_vg.graph.subgraph import Subgraph
from colmap_vg.solution import LogEntry, PoseSolution
from colmap_vg.verdicts import EdgeVerdict, ImageVerdict, SolutionStatus
from colmap_vg.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class Ledger:
    """Verdicts on a graph's images and edges, starting from those given on reading.

    Attributes
    ----------
    graph : ViewGraph
    edge_verdicts : (m,) object array of EdgeVerdict
    image_verdicts : (n,) object array of ImageVerdict
    log : list of LogEntry
    caveats : list of str
        Sentences on what could not be had in full.
    """

    def __init__(self, graph: ViewGraph) -> None:
        read = graph.read_verdicts
        self.graph = graph
        self.edge_verdicts: NDArray[np.object_] = (
            np.full(graph.num_edges, EdgeVerdict.KEPT, dtype=object) if read is None else read.astype(object)
        )
        self.image_verdicts: NDArray[np.object_] = np.full(graph.num_images, ImageVerdict.NO_EDGES, dtype=object)
        self.log: list[LogEntry] = []
        self.caveats: list[str] = []

    @property
    def usable(self) -> BoolArray:
        """Edges that no test has dropped so far, (m,)."""
        return np.isin(self.edge_verdicts.astype(str), [EdgeVerdict.KEPT, EdgeVerdict.ROTATION_ONLY])

    def drop(self, edge_rows: IntArray, verdict: EdgeVerdict) -> None:
        """Drop edges for a reason."""
        self.edge_verdicts[edge_rows] = verdict

    def restore(self, edge_rows: IntArray) -> None:
        """Take dropped edges back."""
        self.edge_verdicts[edge_rows] = EdgeVerdict.KEPT

    def largest_component(self, images: BoolArray, otherwise: ImageVerdict) -> Subgraph:
        """Largest connected component among the images marked; the others of them that had edges get the verdict."""
        edges = self.usable & images[self.graph.edges].all(axis=1)
        linked = np.zeros(self.graph.num_images, dtype=bool)
        linked[self.graph.edges[edges].ravel()] = True
        inside = linked & (components_by_size(self.graph.num_images, self.graph.edges[edges]) == 0)
        had_edges = linked | (self.image_verdicts == ImageVerdict.REGISTERED)
        self.image_verdicts[images & had_edges & ~inside] = otherwise
        self.image_verdicts[inside] = ImageVerdict.REGISTERED
        return Subgraph.of(self.graph.edges, inside, edges)

    def largest_rigid_part(self, part: Subgraph, seed: int) -> Subgraph:
        """Largest parallel-rigid part by edges with a direction; the part's other images become ``not_rigid``."""
        directed = self.edge_verdicts[part.edge_rows] == EdgeVerdict.KEPT
        images, edges = largest_rigid_component(part.num_images, part.edges[directed], seed)
        self.image_verdicts[part.images[~images]] = ImageVerdict.NOT_RIGID
        inside = np.zeros(self.graph.num_images, dtype=bool)
        inside[part.images[images]] = True
        kept = np.zeros(self.graph.num_edges, dtype=bool)
        kept[part.edge_rows[directed][edges]] = True
        return Subgraph.of(self.graph.edges, inside, kept)

    def unsolvable(self, message: str) -> PoseSolution:
        """A solution without a registered image."""
        self.image_verdicts[self.image_verdicts == ImageVerdict.REGISTERED] = ImageVerdict.NOT_RIGID
        nobody = np.zeros(self.graph.num_images, dtype=bool)
        part = Subgraph.of(self.graph.edges, nobody, np.zeros(self.graph.num_edges, dtype=bool))
        solution = self.solution(part, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.ones(num_cameras(self.graph)), True)
        return replace(solution, status=SolutionStatus.UNSOLVABLE, message=message)

    def solution(
        self, part: Subgraph, rotations: Array, centers: Array, focal_scales: Array, converged: bool
    ) -> PoseSolution:
        """Poses of a part in the graph's order, with centroid 0 and root mean square distance 1."""
        n = self.graph.num_images
        registered = np.zeros(n, dtype=bool)
        registered[part.images] = True
        R, p = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
        R[part.images] = so3.project(rotations)
        if part.num_images:
            moved = centers - centers.mean(axis=0)
            p[part.images] = moved / np.sqrt(np.mean(np.sum(moved**2, axis=1)))
        self.drop(np.flatnonzero(self.usable & ~registered[self.graph.edges].all(axis=1)), EdgeVerdict.OUTSIDE)
        status, message = described(self.image_verdicts, converged)
        return PoseSolution(
            image_ids=self.graph.image_ids,
            cam_from_world_rotations=R,
            projection_centers=p,
            registered=registered,
            component=np.where(registered, 0, -1),
            focal_scales=focal_scales,
            edge_kept=self.usable,
            edge_verdicts=self.edge_verdicts.astype(str),
            image_verdicts=self.image_verdicts.astype(str),
            status=status,
            message=message,
            caveats=tuple(self.caveats),
            log=tuple(self.log),
        )


def described(image_verdicts: NDArray[np.generic], converged: bool) -> tuple[SolutionStatus, str]:
    """Status of a solution with some image registered, and the sentence that tells it."""
    words, counts = np.unique(image_verdicts.astype(str), return_counts=True)
    left_out = {str(w): int(c) for w, c in zip(words, counts, strict=True) if w != ImageVerdict.REGISTERED}
    status, message = SolutionStatus.SOLVED, f"All {len(image_verdicts)} images are registered."
    if left_out:
        reasons = ", ".join(f"{count} {word}" for word, count in left_out.items())
        status, message = (
            SolutionStatus.PARTIAL,
            f"{sum(left_out.values())} of {len(image_verdicts)} images are left out",
        )
        message += f" ({reasons}); see image_verdicts."
    if not converged:
        status = SolutionStatus.NOT_CONVERGED
        message += " The iteration limit was reached: raise max_num_iterations, or look for outliers in the graph."
    return status, message


def num_cameras(graph: ViewGraph) -> int:
    """Number of cameras that a graph tells of; 0 when it tells of none."""
    if graph.camera_focal_lengths is not None:
        return len(graph.camera_focal_lengths)
    return 0 if graph.camera_idx is None or len(graph.camera_idx) == 0 else int(graph.camera_idx.max()) + 1
