"""State of a solve: current verdicts on images and edges, solved poses, and the iteration log."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.scene.components import components_by_size
from colmap_vg.scene.edge_residuals import graph_residual_sigmas
from colmap_vg.scene.solution import Agreement, LogEntry, PoseSolution
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import USED_EDGES, EdgeVerdict, ImageVerdict, SolutionStatus
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.agreement import pair_agreement
from colmap_vg.solver.position_links import link_by_positions
from colmap_vg.solver.rig_links import link_components
from colmap_vg.solver.rigidity import largest_rigid_component

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_PART_IMAGES = 3
"""Minimum number of images of a solved part: two images determine only a direction."""
MIN_AGREEMENT = 0.65
"""Share of inlier matches that agree below which a model is doubtful. Correct models of objects that repeat themselves
had 0.74 to 0.95, those of other photographs 0.98 and more; folded models 0.64 to 0.86."""


class SolverState:
    """Verdicts on a graph's images and edges, initialised with those from reading, and poses solved so far.

    Attributes
    ----------
    graph : ViewGraph
    edge_verdicts : (m,) object array of EdgeVerdict
    image_verdicts : (n,) object array of ImageVerdict
    log : list of LogEntry
    caveats : list of str
        Sentences on limitations of the solution.
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
        self._R, self._p = np.full((graph.num_images, 3, 3), np.nan), np.full((graph.num_images, 3), np.nan)
        self._component = np.full(graph.num_images, -1, dtype=np.int64)
        self._focal_scales = np.ones(num_cameras(graph))
        self._radial_terms = np.zeros(num_cameras(graph))
        self._seen_cameras = np.zeros(num_cameras(graph), dtype=bool)
        self._converged = True
        self._covariances: Array | None = None
        self._in_doubt: BoolArray | None = None
        self._uncertain: BoolArray | None = None
        self._arrangements: list[Array] = []
        self._ratios = np.zeros((0, 2), dtype=np.int64)

    @property
    def usable(self) -> BoolArray:
        """Mask (m,) of the edges that no test has dropped."""
        return np.isin(self.edge_verdicts.astype(str), USED_EDGES)

    @property
    def trusted(self) -> BoolArray:
        """Mask (m,) of the edges that no test may drop."""
        return np.zeros(self.graph.num_edges, dtype=bool) if self.graph.trusted is None else self.graph.trusted

    def drop(self, edge_rows: IntArray, verdict: EdgeVerdict) -> None:
        """Drop edges with a verdict, except trusted ones."""
        self.edge_verdicts[edge_rows[~self.trusted[edge_rows]]] = verdict

    def restore(self, edge_rows: IntArray) -> None:
        """Restore dropped edges."""
        self.edge_verdicts[edge_rows] = EdgeVerdict.KEPT

    def note_arrangements(self, part: Subgraph, rotations: tuple[Array, ...]) -> None:
        """Record the solved and alternative rotations (k, 3, 3) of a part; only of the first part, the largest."""
        if not self._arrangements:
            for own in rotations:
                self._arrangements.append(np.full((self.graph.num_images, 3, 3), np.nan))
                self._arrangements[-1][part.images] = own

    def doubt(self, images: IntArray, reason: str) -> None:
        """Mark images whose pose is in doubt, with the reason as a sentence."""
        self._in_doubt = self._marked(self._in_doubt, images)
        self.caveats.append(reason)

    def note_uncertain(self, images: IntArray, reason: str) -> None:
        """Mark images whose positions are hardly known, with the reason as a sentence."""
        self._uncertain = self._marked(self._uncertain, images)
        self.caveats.append(reason)

    def _marked(self, before: BoolArray | None, images: IntArray) -> BoolArray:
        """Mask (n,) of the images marked before and now."""
        marked = np.zeros(self.graph.num_images, dtype=bool) if before is None else before.copy()
        marked[images] = True
        return marked

    def remove_images(self, part: Subgraph, verdict: ImageVerdict) -> None:
        """Give the images of a part a verdict, except those that were removed earlier."""
        in_question = self.image_verdicts[part.images] == ImageVerdict.REGISTERED
        self.image_verdicts[part.images[in_question]] = verdict

    def largest_component(self, images: BoolArray, otherwise: ImageVerdict) -> Subgraph:
        """Largest connected component of the marked images; the others of them that had edges get the verdict."""
        edges = self.usable & images[self.graph.edges].all(axis=1)
        linked = np.zeros(self.graph.num_images, dtype=bool)
        linked[self.graph.edges[edges].ravel()] = True
        inside = linked & (components_by_size(self.graph.num_images, self.graph.edges[edges]) == 0)
        in_question = self.image_verdicts == ImageVerdict.REGISTERED
        in_question |= linked & (self.image_verdicts == ImageVerdict.NO_EDGES)
        self.image_verdicts[images & in_question & ~inside] = otherwise
        self.image_verdicts[inside] = ImageVerdict.REGISTERED
        return Subgraph.of(self.graph.edges, inside, edges)

    def note_ratios(self, edge_rows: IntArray) -> None:
        """Record the pairs (q, 2) of the graph's edges with a reliable ratio of lengths, replacing earlier ones."""
        self._ratios = edge_rows

    def largest_rigid_part(self, part: Subgraph, seed: int) -> Subgraph:
        """Largest part that directions and length ratios determine; the part's other images become ``not_rigid``."""
        directed = self.edge_verdicts[part.edge_rows] == EdgeVerdict.KEPT
        row = np.full(self.graph.num_edges, -1, dtype=np.int64)
        row[part.edge_rows[directed]] = np.arange(int(directed.sum()))
        ratios = row[self._ratios]
        ratios = ratios[(ratios >= 0).all(axis=1)]
        images, edges = largest_rigid_component(part.num_images, part.edges[directed], seed, ratios)
        self.image_verdicts[part.images[images]] = ImageVerdict.REGISTERED
        self.image_verdicts[part.images[~images]] = ImageVerdict.NOT_RIGID
        inside = np.zeros(self.graph.num_images, dtype=bool)
        inside[part.images[images]] = True
        kept = np.zeros(self.graph.num_edges, dtype=bool)
        kept[part.edge_rows[directed][edges]] = True
        return Subgraph.of(self.graph.edges, inside, kept)

    def without(self, part: Subgraph, removed: BoolArray, verdict: ImageVerdict, seed: int) -> Subgraph:
        """Remove some of a part's images (k,) with a verdict; return the largest parallel-rigid part of the others."""
        self.image_verdicts[part.images[removed]] = verdict
        remaining = np.zeros(self.graph.num_images, dtype=bool)
        remaining[part.images[~removed]] = True
        kept = np.zeros(self.graph.num_edges, dtype=bool)
        kept[part.edge_rows] = True
        return self.largest_rigid_part(Subgraph.of(self.graph.edges, remaining, kept), seed)

    def record_poses(
        self,
        part: Subgraph,
        rotations: Array,
        centers: Array,
        focal_scales: Array,
        converged: bool,
        covariances: tuple[Array, Array] | None = None,
        radial_terms: Array | None = None,
    ) -> None:
        """Record the poses of a part as a new component, normalised to centroid 0 and root mean square distance 1.

        `covariances` are those of the centres and of the rotations, (k, 3, 3) each.
        """
        moved = centers - centers.mean(axis=0)
        if covariances is not None:
            self._covariances = (
                np.full((2, self.graph.num_images, 3, 3), np.nan) if self._covariances is None else self._covariances
            )
            self._covariances[0, part.images] = covariances[0] / np.mean(np.sum(moved**2, axis=1))
            self._covariances[1, part.images] = covariances[1]
        self._R[part.images] = so3.project(rotations)
        self._p[part.images] = moved / np.sqrt(np.mean(np.sum(moved**2, axis=1)))
        self._component[part.images] = self._component.max(initial=-1) + 1
        self._converged &= converged
        if self.graph.camera_idx is not None:
            # A camera of two components keeps the values from the larger one.
            cameras = np.zeros(len(focal_scales), dtype=bool)
            cameras[self.graph.camera_idx[part.images]] = True
            own = cameras & ~self._seen_cameras
            self._focal_scales[own] = focal_scales[own]
            if radial_terms is not None:
                self._radial_terms[own] = radial_terms[own]
            self._seen_cameras |= cameras

    def link_by_rigs(self) -> None:
        """Join components that frames of calibrated rigs link, and normalise the result as one component."""
        rigs = self.graph.rigs
        if rigs is None or self._component.max(initial=-1) < 1:
            return
        self._take_links(
            link_components(rigs, self._R, self._p, self._component),
            "images are linked to the others by their rig alone: no pair confirms their place.",
        )

    def link_by_positions(self) -> None:
        """Join components that a pair and measured positions link, and normalise the result as one component."""
        if self.graph.priors is None or self._component.max(initial=-1) < 1:
            return
        self._take_links(
            link_by_positions(self.graph, self.edge_verdicts == EdgeVerdict.KEPT, self._R, self._p, self._component),
            "images are linked to the others by one pair only: their scale is that of the measured positions.",
        )

    def _take_links(self, component: IntArray, told: str) -> None:
        """Normalise components that grew by others, and say how many images were linked."""
        before, self._component = self._component, component
        for grown in np.unique(self._component[self._component != before]):
            inside = self._component == grown
            moved = self._p[inside] - self._p[inside].mean(axis=0)
            unit = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
            self._p[inside] = moved / unit
            if self._covariances is not None:
                # Those of the linked images lack the link's own uncertainty.
                self._covariances[0, inside & (before != grown)] = np.nan
                self._covariances[0, inside & (before == grown)] /= unit**2
            self.caveats.append(f"{int((inside & (before != grown)).sum())} {told}")
        self._component[self._component >= 0] = np.unique(self._component[self._component >= 0], return_inverse=True)[1]

    def solution(self) -> PoseSolution:
        """Solution with all recorded poses, in the graph's order; unsolvable if there are none."""
        component = self._component
        if component.max(initial=-1) >= 0:
            sizes = np.bincount(component[component >= 0])
            rank = np.empty(len(sizes), dtype=np.int64)
            rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
            component = np.where(component >= 0, rank[component], -1)
        self.image_verdicts[component == 0] = ImageVerdict.REGISTERED
        self.image_verdicts[component > 0] = ImageVerdict.OTHER_MODEL
        ends = component[self.graph.edges]
        inside = (ends[:, 0] >= 0) & (ends[:, 0] == ends[:, 1])
        # Edges used for rotations only keep their verdict, which may be the reason why their images are outside.
        self.edge_verdicts[(self.edge_verdicts == EdgeVerdict.KEPT) & ~inside] = EdgeVerdict.OUTSIDE
        agreement = pair_agreement(self.graph, self._R, self._p, component)
        in_doubt = self._in_doubt is not None and bool((self._in_doubt & (component >= 0)).any())
        uncertain = self._uncertain is not None and bool((self._uncertain & (component == 0)).any())
        status, message = described(self.image_verdicts, self._converged, agreement, in_doubt, uncertain)
        still = int((self.edge_verdicts == EdgeVerdict.ROTATION_ONLY).sum())
        if status == SolutionStatus.UNSOLVABLE and still:
            message += f" In {still} of {self.graph.num_edges} pairs the camera seems to have rotated without moving."
        return PoseSolution(
            image_ids=self.graph.image_ids,
            cam_from_world_rotations=self._R,
            projection_centers=self._p,
            registered=component == 0,
            component=component,
            focal_scales=self._focal_scales,
            radial_terms=self._radial_terms if self._radial_terms.any() else None,
            edge_kept=self.usable & inside,
            edge_verdicts=self.edge_verdicts.astype(str),
            image_verdicts=self.image_verdicts.astype(str),
            status=status,
            message=message,
            converged=self._converged,
            caveats=tuple(self.caveats),
            position_covariances=None if self._covariances is None else self._covariances[0],
            rotation_covariances=None if self._covariances is None else self._covariances[1],
            edge_residual_sigmas=graph_residual_sigmas(self.graph, self._R, self._p, component),
            agreement=agreement,
            in_doubt=self._in_doubt if in_doubt else None,
            uncertain=self._uncertain if uncertain else None,
            arrangements=tuple(self._arrangements),
            log=tuple(self.log),
        )


def described(
    image_verdicts: NDArray[np.generic],
    converged: bool,
    agreement: tuple[Agreement, ...],
    in_doubt: bool,
    uncertain: bool,
) -> tuple[SolutionStatus, str]:
    """Status of a solution, and the message that explains it."""
    words, counts = np.unique(image_verdicts.astype(str), return_counts=True)
    elsewhere = {str(w): int(c) for w, c in zip(words, counts, strict=True) if w != ImageVerdict.REGISTERED}
    if sum(elsewhere.values()) == len(image_verdicts):
        return SolutionStatus.UNSOLVABLE, (
            "No three images are linked by directions or tracks that determine their positions: "
            "add overlapping photographs, taken from different places."
        )
    status, message = SolutionStatus.SOLVED, f"All {len(image_verdicts)} images are registered."
    if elsewhere:
        reasons = ", ".join(f"{count} {word}" for word, count in elsewhere.items())
        status = SolutionStatus.PARTIAL
        message = f"{sum(elsewhere.values())} of {len(image_verdicts)} images are not in the largest model"
        message += f" ({reasons}); see image_verdicts."
    if not converged:
        status = SolutionStatus.NOT_CONVERGED
        message += " The iteration limit was reached: raise max_num_iterations, or look for outliers in the graph."
    if agreement:
        shares = f"{agreement[0].inliers:.3f} of the inlier matches and {agreement[0].pairs:.3f} of the pairs"
        message += f" {shares} agree with the model within 5°."
    if in_doubt or any(part.inliers < MIN_AGREEMENT for part in agreement):
        status = SolutionStatus.DOUBTFUL
        why = "another arrangement fits nearly as well" if in_doubt else "too many pairs contradict it"
        message += (
            f" The model is doubtful: {why}. Look at it, exclude pairs that are wrong, or add photographs between the"
            " views that look alike."
        )
    if uncertain:
        status = SolutionStatus.DOUBTFUL
        message += " The positions are hardly known: move the camera more between the photographs."
    return status, message


def num_cameras(graph: ViewGraph) -> int:
    """Number of cameras of a graph; 0 if it has no camera data."""
    if graph.camera_focal_lengths is not None:
        return len(graph.camera_focal_lengths)
    return 0 if graph.camera_idx is None or len(graph.camera_idx) == 0 else int(graph.camera_idx.max()) + 1
