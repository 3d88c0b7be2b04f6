"""What links the models of a job, and where few pairs hold one together: how firm it is, and what is missing."""

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
    """A verified pair of images of two models, or of two sides of one."""

    images: tuple[str, str]
    verdict: str
    num_inliers: int


@dataclass(frozen=True)
class Bridge:
    """What links two models, or two sides of one.

    Attributes
    ----------
    models : tuple of int
        Twice the same for sides of one model.
    images : tuple of str
        Of the smaller side of a model, the first ones; empty between two models.
    num_images : int
        Of that side; 0 between two models.
    num_pairs, num_inliers : int
        Verified pairs that link, and their inlier matches.
    strongest : tuple of LinkingPair
    share_seen, share_seen_elsewhere : float or None
        Of points that one side sees and near images of the other should, the share that these see; and that of such
        points within the sides. None where nothing can be told, and between models.
    firm : bool
        Whether the sides show one place as far as can be told; models are two because nothing firm links them.
    told : str
        All that in a sentence, and what is missing.
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
    """Bridges between all models of a solution, and within each.

    Parameters
    ----------
    graph : ViewGraph
    solution : PoseSolution
    weak_cuts : sequence of sequences of WeakCut
        Of each model.
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
        told = (
            f"no pair links models {a} and {b}: photographs that overlap both are missing, two or more from places"
            " between them"
        )
    else:
        first, second = strongest[0].images
        told = (
            f"{_pairs(len(rows))} with {num_inliers} inlier matches link models {a} and {b}, the strongest {first} and"
            f" {second}, {_why_not(solution, rows)}"
        )
    return Bridge((a, b), (), 0, len(rows), num_inliers, strongest, None, None, False, told)


def _why_not(solution: PoseSolution, rows: IntArray) -> str:
    """Why pairs do not make one model of two, and what would."""
    verdicts = Counter(solution.edge_verdicts[rows].tolist())
    usable = sum(verdicts[str(word)] for word in (EdgeVerdict.KEPT, EdgeVerdict.OUTSIDE))
    if usable:
        return (
            "but neither their directions nor tracks through three images fix how the two lie to each other: one more"
            " photograph that overlaps these two and a neighbour of each would"
        )
    reasons = ", ".join(f"{count} {word}" for word, count in verdicts.most_common())
    return f"but none of them can be relied on ({reasons}): two photographs or more that overlap both would tell"


def _within(graph: ViewGraph, solution: PoseSolution, model: int, cut: WeakCut) -> Bridge:
    inside = np.isin(graph.image_ids, sorted(cut.images))
    ends = inside[graph.edges]
    rows = np.flatnonzero((ends[:, 0] != ends[:, 1]) & (solution.component[graph.edges] == model).all(axis=1))
    names = [name for name, own in zip(image_names(graph), inside.tolist(), strict=True) if own]
    told = (
        f"{len(names)} images of model {model} ({names[0]} to {names[-1]}) are held to the rest by"
        f" {_pairs(cut.num_pairs)} with {cut.num_matches} matches"
    )
    seen = cut.share_seen if cut.num_expected else None
    if seen is None:
        told += "; no images of both sides look at points from nearly the same side, to confirm it"
    elif cut.contradicted:
        told += (
            f", but only {seen:.2f} of what both sides should see is seen by both ({cut.share_seen_elsewhere:.2f}"
            " elsewhere): they may show another place that looks alike"
        )
    else:
        told += f"; {seen:.2f} of what both sides should see is seen by both ({cut.share_seen_elsewhere:.2f} elsewhere)"
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
