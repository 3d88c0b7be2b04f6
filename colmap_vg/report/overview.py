"""What the top of the report says: result, caveats, what was left out and why, times and options."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from colmap_vg.jobs.summary import georeference_line
from colmap_vg.jobs.verdict_tables import ImageRow
from colmap_vg.report.contents import Contents
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict, SolutionStatus


@dataclass(frozen=True)
class Group:
    """Images or pairs with the same verdict."""

    verdict: str
    reason: str
    count: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelLine:
    """Figures of a model, as text."""

    name: str
    images: str
    points: str
    track_length: str
    error: str
    inliers: str
    pairs: str
    directions: str


@dataclass(frozen=True)
class Overview:
    """The text of the report.

    Attributes
    ----------
    verb, version, status, meaning : str
        `meaning` explains the status.
    grave : bool
        Whether the result is not to be trusted without a look.
    num_images, num_registered, num_pairs, num_used : int
    models : tuple of ModelLine
    warnings, bridges : tuple of str
    removed : tuple of Group
        Images that are in no model.
    pairs : tuple of Group
        Pairs by verdict.
    stages : tuple of (str, float, float, str)
        Name, seconds, peak memory and result.
    seconds, peak_memory_mib : float
    options : tuple of (str, str)
    georeferences : tuple of str
        Frame and measured positions of each georeferenced model.
    comparison : tuple of (str, str)
        Errors against the true cameras; empty except for demos.
    """

    verb: str
    version: str
    status: str
    meaning: str
    grave: bool
    num_images: int
    num_registered: int
    num_pairs: int
    num_used: int
    models: tuple[ModelLine, ...]
    warnings: tuple[str, ...]
    bridges: tuple[str, ...]
    removed: tuple[Group, ...]
    pairs: tuple[Group, ...]
    stages: tuple[tuple[str, float, float, str], ...]
    seconds: float
    peak_memory_mib: float
    options: tuple[tuple[str, str], ...]
    georeferences: tuple[str, ...]
    comparison: tuple[tuple[str, str], ...]


def overview(contents: Contents) -> Overview:
    """Make the text of the report.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError
        The summary lacks what this version writes.
    """
    summary = contents.summary
    status = str(summary["status"])
    edges: Mapping[str, Any] = summary["edges"]
    used = ("used", "used by the solution", int(edges["num_kept"]))
    dropped = [(word, EdgeVerdict.reason_of(word), int(count)) for word, count in edges["dropped"].items()]
    return Overview(
        str(summary["verb"]),
        str(summary["version"]),
        status,
        SolutionStatus.reason_of(status),
        status in (SolutionStatus.DOUBTFUL, SolutionStatus.NOT_CONVERGED, SolutionStatus.UNSOLVABLE),
        len(contents.images),
        sum(bool(row.model) for row in contents.images),
        int(edges["num_edges"]),
        int(edges["num_kept"]),
        _models(contents),
        tuple(map(str, summary["warnings"])),
        tuple(str(bridge["told"]) for bridge in summary.get("bridges", [])),
        _removed(contents.images),
        tuple(Group(*row) for row in [used, *dropped] if row[2]),
        tuple(
            (str(s["stage"]), float(s["seconds"]), float(s["peak_memory_mib"]), str(s["message"]))
            for s in summary["stages"]
        ),
        float(summary["seconds"]),
        float(summary["peak_memory_mib"]),
        tuple(_flat("", summary["options"])),
        tuple(
            f"Model {name}: {georeference_line(model['georeference'])}."
            for name, model in enumerate(summary.get("models", []))
            if model.get("georeference")
        ),
        tuple(_flat("", summary.get("comparison", {}))),
    )


def _models(contents: Contents) -> tuple[ModelLine, ...]:
    """Lines on the models; a job of the verb `solve` has no figures of them."""
    figures: Sequence[Mapping[str, Any]] = contents.summary.get("models", [])
    lines = []
    for index, view in enumerate(contents.models):
        model = figures[index] if index < len(figures) else {}
        agreement = model.get("agreement") or {}
        shares = [agreement.get(name) for name in ("inliers", "pairs", "directions")]
        lines.append(
            ModelLine(
                view.name,
                f"{len(view.images):,}",
                f"{view.num_points:,}",
                f"{model['mean_track_length']:.1f}" if model else "",
                f"{model['mean_reprojection_error_px']:.2f} px" if model else "",
                *("" if share is None else f"{share:.1%}" for share in shares),
            )
        )
    return tuple(lines)


def _removed(images: Sequence[ImageRow]) -> tuple[Group, ...]:
    names: dict[str, list[str]] = defaultdict(list)
    for row in images:
        if not row.model:
            names[row.verdict].append(row.image)
    groups = [Group(word, ImageVerdict.reason_of(word), len(own), tuple(own)) for word, own in names.items()]
    return tuple(sorted(groups, key=lambda group: -group.count))


def _flat(prefix: str, value: object) -> list[tuple[str, str]]:
    """Options of options under joined names."""
    if isinstance(value, Mapping):
        return [row for name, item in value.items() for row in _flat(f"{prefix}.{name}" if prefix else str(name), item)]
    if isinstance(value, float):
        return [(prefix, f"{value:.6g}")]
    if isinstance(value, list):
        return [(prefix, ", ".join(map(str, value)))]
    return [(prefix, "" if value is None else str(value))]
