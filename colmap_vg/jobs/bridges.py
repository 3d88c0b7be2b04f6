"""Describe the pairs that link the models of a job, and the weak cuts within each model."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.jobs.verdict_tables import image_names
from colmap_vg.mapping.weak_cuts import WeakCut
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph

IntArray = NDArray[np.int64]

MAX_MODELS, MAX_PAIRS_SHOWN, MAX_IMAGES_SHOWN = 10, 10, 10


@dataclass(frozen=True)
class LinkingPair:
    """A verified pair between two models, or between the two sides of a weak cut."""

    images: tuple[str, str]
    verdict: str
    num_inliers: int


@dataclass(frozen=True)
class Bridge:
    """The link between two models, or between the two sides of a weak cut in one model.

    Attributes
    ----------
    models : tuple of int
        Both models; the same index twice for a cut within a model.
    images : tuple of str
        Names of the first images of a cut's smaller side; empty between two models.
    num_images : int
        Number of images of that side; 0 between two models.
    num_pairs, num_inliers : int
        Number of verified pairs across, and of their inlier matches.
    strongest : tuple of LinkingPair
        The pairs with most inlier matches.
    share_seen, share_seen_elsewhere : float or None
        Share of the expected observations that exist, across the cut and within its sides; see `WeakCut`. None
        between models; `share_seen` also where no observations are expected.
    firm : bool
        Whether the expected observations do not contradict that the sides show one place; False between models.
    told : str
        A sentence that describes the link, and what is missing.
    """

    models: tuple[int, int]
    images: tuple[str, ...]
    num_images: int
    num_pairs: int
    num_inliers: int
    strongest: tuple[LinkingPair, ...]
    share_seen: float | None
    share_seen_elsewhere: float | None
    firm: bool
    told: str


def all_bridges(
    graph: ViewGraph, solution: PoseSolution, weak_cuts: Sequence[Sequence[WeakCut]] = ()
) -> tuple[Bridge, ...]:
    """List the bridges within each model of a solution, and between its models.

    Parameters
    ----------
    graph : ViewGraph
    solution : PoseSolution
    weak_cuts : sequence of sequences of WeakCut
        The weak cuts of each model.
    """
    found = [_within(graph, solution, model, cut) for model, cuts in enumerate(weak_cuts) for cut in cuts]
    last = min(int(solution.component.max(initial=-1)), MAX_MODELS - 1)
    found += [_between(graph, solution, a, b) for a in range(last + 1) for b in range(a + 1, last + 1)]
    return tuple(found)


def _between(graph: ViewGraph, solution: PoseSolution, a: int, b: int) -> Bridge:
    ends = np.sort(solution.component[graph.edges], axis=1)
    rows = np.flatnonzero((ends == [a, b]).all(axis=1))
    strongest, num_inliers = _strongest(graph, solution, rows), _num_inliers(graph, rows)
    if len(rows) == 0:
        told = f"no pair links models {a} and {b}: add two or more photographs, taken between them, that overlap both"
    else:
        first, second = strongest[0].images
        told = (
            f"{_pairs(len(rows))} with {num_inliers} inlier matches link models {a} and {b} (the strongest: {first} and"
            f" {second}), {_why_not(solution, rows)}"
        )
    return Bridge((a, b), (), 0, len(rows), num_inliers, strongest, None, None, False, told)


def _why_not(solution: PoseSolution, rows: IntArray) -> str:
    """Clause on why pairs do not join two models, and which photographs would."""
    verdicts = Counter(solution.edge_verdicts[rows].tolist())
    usable = sum(verdicts[str(word)] for word in (EdgeVerdict.KEPT, EdgeVerdict.OUTSIDE))
    if usable:
        return (
            "but neither their directions nor tracks through three images determine the relative position of the"
            " models: add a photograph that overlaps these two images and a neighbour of each"
        )
    reasons = ", ".join(f"{count} {word}" for word, count in verdicts.most_common())
    return f"but none of them is reliable ({reasons}): add two or more photographs that overlap both models"


def _within(graph: ViewGraph, solution: PoseSolution, model: int, cut: WeakCut) -> Bridge:
    inside = np.isin(graph.image_ids, sorted(cut.images))
    ends = inside[graph.edges]
    rows = np.flatnonzero((ends[:, 0] != ends[:, 1]) & (solution.component[graph.edges] == model).all(axis=1))
    names = [name for name, own in zip(image_names(graph), inside.tolist(), strict=True) if own]
    told = (
        f"{len(names)} images of model {model} ({names[0]} to {names[-1]}) are linked to the rest by only"
        f" {_pairs(cut.num_pairs)} with {cut.num_matches} matches"
    )
    seen = cut.share_seen if cut.num_expected else None
    if seen is None:
        told += "; this cannot be confirmed, since no images of the two sides have similar views of the same points"
    elif cut.contradicted:
        told += (
            f", and both sides see only a share of {seen:.2f} of the points that both should see"
            f" ({cut.share_seen_elsewhere:.2f} elsewhere): they may show another place that looks alike"
        )
    else:
        told += (
            f"; both sides see a share of {seen:.2f} of the points that both should see"
            f" ({cut.share_seen_elsewhere:.2f} elsewhere)"
        )
    return Bridge(
        (model, model),
        tuple(names[:MAX_IMAGES_SHOWN]),
        len(names),
        cut.num_pairs,
        cut.num_matches,
        _strongest(graph, solution, rows),
        seen,
        cut.share_seen_elsewhere,
        not cut.contradicted,
        told,
    )


def _strongest(graph: ViewGraph, solution: PoseSolution, rows: IntArray) -> tuple[LinkingPair, ...]:
    names, inliers = image_names(graph), _inliers(graph)
    return tuple(
        LinkingPair((names[i], names[j]), str(solution.edge_verdicts[row]), int(inliers[row]))
        for row in rows[np.argsort(-inliers[rows], kind="stable")][:MAX_PAIRS_SHOWN].tolist()
        for i, j in [graph.edges[row].tolist()]
    )


def _num_inliers(graph: ViewGraph, rows: IntArray) -> int:
    return int(_inliers(graph)[rows].sum())


def _inliers(graph: ViewGraph) -> IntArray:
    return np.zeros(graph.num_edges, dtype=np.int64) if graph.num_inliers is None else graph.num_inliers


def _pairs(count: int) -> str:
    return "1 pair" if count == 1 else f"{count} pairs"
