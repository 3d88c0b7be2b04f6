"""Tables of the verdicts on all images and pairs, written as CSV files beside the models, and explanations from them.

The tables hold one row per image and per verified pair of the database, with its verdict and the difference between the
pair's relative pose and that of the finished model.
"""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError
from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.agreement import MAX_ROTATION_DEG, pose_errors_deg

IMAGES_NAME, PAIRS_NAME = "images.csv", "pairs.csv"
_IMAGE_COLUMNS = (
    "image",
    "model",
    "verdict",
    "num_pairs",
    "num_kept_pairs",
    "position_sigma_percent",
    "rotation_sigma_deg",
)
_PAIR_COLUMNS = ("image1", "image2", "verdict", "num_inliers", "rotation_error_deg", "direction_error_deg", "sigmas")
MAX_PAIRS_SHOWN = 30


@dataclass(frozen=True)
class ImageRow:
    """A row of ``images.csv``; `model` is empty for an image that is in no model.

    Standard deviations are those of the viewing graph's solution, before bundle adjustment, if covariances were
    requested: of the position in percent of the scene's radius (root mean square), of the rotation in degrees.
    """

    image: str
    model: str
    verdict: str
    num_pairs: int
    num_kept_pairs: int
    position_sigma_percent: str = ""
    rotation_sigma_deg: str = ""


@dataclass(frozen=True)
class PairRow:
    """A row of ``pairs.csv``; errors are empty where the pair's images are not in the same model.

    `sigmas` is the error of the relative pose in standard deviations, which follow from the pair's matches.
    """

    image1: str
    image2: str
    verdict: str
    num_inliers: str
    rotation_error_deg: str
    direction_error_deg: str
    sigmas: str = ""


@dataclass(frozen=True)
class VerdictTables:
    """The rows of both tables."""

    images: tuple[ImageRow, ...]
    pairs: tuple[PairRow, ...]


def verdict_tables(graph: ViewGraph, solution: PoseSolution, skipped: Mapping[str, str] | None = None) -> VerdictTables:
    """Make the tables of a graph and its solution.

    Parameters
    ----------
    graph : ViewGraph
    solution : PoseSolution
    skipped : mapping of str to str, optional
        Files that were skipped before feature extraction, with the reasons.
    """
    names = image_names(graph)
    count = np.bincount(graph.edges.ravel(), minlength=graph.num_images)
    kept = np.bincount(graph.edges[solution.edge_kept].ravel(), minlength=graph.num_images)
    position, turn = deviations(solution)
    images = [
        ImageRow(name, str(model) if model >= 0 else "", str(verdict), int(own), int(num_kept), _number(p), _number(t))
        for name, model, verdict, own, num_kept, p, t in zip(
            names, solution.component.tolist(), solution.image_verdicts, count, kept, position, turn, strict=True
        )
    ]
    images += [ImageRow(name, "", reason, 0, 0) for name, reason in (skipped or {}).items()]
    rotation, direction = pose_errors_deg(
        graph, solution.cam_from_world_rotations, solution.projection_centers, solution.component
    )
    inliers = [""] * graph.num_edges if graph.num_inliers is None else [str(k) for k in graph.num_inliers.tolist()]
    sigmas = solution.edge_residual_sigmas
    if sigmas is None:
        sigmas = np.full(graph.num_edges, np.nan)
    pairs = [
        PairRow(names[i], names[j], str(verdict), k, _number(r), _number(d), _number(s))
        for (i, j), verdict, k, r, d, s in zip(
            graph.edges.tolist(), solution.edge_verdicts, inliers, rotation, direction, sigmas, strict=True
        )
    ]
    return VerdictTables(tuple(images), tuple(pairs))


def deviations(solution: PoseSolution) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard deviations of positions (n,), percent of their model's radius, and of rotations (n,), degrees.

    NaN where they are unknown.
    """
    if solution.position_covariances is None or solution.rotation_covariances is None:
        unknown = np.full(len(solution.image_ids), np.nan)
        return unknown, unknown
    position = np.sqrt(np.trace(solution.position_covariances, axis1=1, axis2=2))
    turn = np.sqrt(np.trace(solution.rotation_covariances, axis1=1, axis2=2))
    for model in range(int(solution.component.max(initial=-1)) + 1):
        rows = solution.component == model
        p = solution.projection_centers[rows]
        position[rows] /= np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))
    return 100.0 * position, np.degrees(turn)


def image_names(graph: ViewGraph) -> list[str]:
    """Names of a graph's images, or their ids if it has no names."""
    return list(graph.image_names or map(str, graph.image_ids.tolist()))


def write_tables(output_path: Path, tables: VerdictTables) -> None:
    """Write both tables, each atomically.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    content: tuple[tuple[str, Sequence[str], Sequence[ImageRow | PairRow]], ...] = (
        (IMAGES_NAME, _IMAGE_COLUMNS, tables.images),
        (PAIRS_NAME, _PAIR_COLUMNS, tables.pairs),
    )
    for name, columns, rows in content:
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(columns)
        writer.writerows([[getattr(row, column) for column in columns] for row in rows])
        atomic_write(output_path / name, text.getvalue())


def read_tables(output_path: Path) -> VerdictTables:
    """Read the tables of a finished job.

    Raises
    ------
    DataFileError
        A table is missing or damaged.
    """
    images = [
        ImageRow(
            r["image"],
            r["model"],
            r["verdict"],
            int(r["num_pairs"]),
            int(r["num_kept_pairs"]),
            r["position_sigma_percent"],
            r["rotation_sigma_deg"],
        )
        for r in _rows(output_path / IMAGES_NAME, _IMAGE_COLUMNS)
    ]
    pairs = [PairRow(*(r[column] for column in _PAIR_COLUMNS)) for r in _rows(output_path / PAIRS_NAME, _PAIR_COLUMNS)]
    return VerdictTables(tuple(images), tuple(pairs))


def _rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise DataFileError(
            f"{path}: {error.strerror}; output_path takes the folder of a finished run or mapper job"
        ) from error
    for number, row in enumerate(rows, start=2):
        if any(row.get(column) is None for column in columns):
            raise DataFileError(f"{path}, line {number}: lacks the columns {', '.join(columns)}; run the job again")
    return rows


def explain_job(tables: VerdictTables, bridges: Sequence[str] = ()) -> list[str]:
    """List the models, their links, the images that are in no model, and the number of pairs by verdict."""
    models = Counter(row.model for row in tables.images if row.model)
    lines = [
        f"model {model}: {count} images{_agreement(tables, model)}"
        for model, count in sorted(models.items(), key=lambda m: int(m[0]))
    ]
    lines += [f"  {told}" for told in bridges]
    left_out = [row for row in tables.images if not row.model]
    lines.append(f"not registered: {len(left_out)} of {len(tables.images)} images")
    lines += [f"  {row.image}: {row.verdict} ({ImageVerdict.reason_of(row.verdict)})" for row in left_out]
    lines.append(f"pairs: {len(tables.pairs)}")
    for verdict, count in Counter(row.verdict for row in tables.pairs).most_common():
        lines.append(f"  {count} {verdict} ({EdgeVerdict.reason_of(verdict)})")
    return lines


def explain_image(tables: VerdictTables, name: str) -> list[str]:
    """Describe an image and its pairs, those with most inlier matches first.

    Raises
    ------
    DataFileError
        The tables hold no such image.
    """
    row = _image(tables, name)
    place = f"in model {row.model}" if row.model else "not registered"
    lines = [f"{row.image}: {place}, {row.verdict} ({ImageVerdict.reason_of(row.verdict)})"]
    lines.append(f"  {row.num_kept_pairs} of its {row.num_pairs} pairs were kept")
    if row.position_sigma_percent:
        lines.append(
            f"  standard deviations before bundle adjustment: position {row.position_sigma_percent} % of the scene's"
            f" radius, rotation {row.rotation_sigma_deg}°"
        )
    pairs = [pair for pair in tables.pairs if name in (pair.image1, pair.image2)]
    pairs.sort(key=lambda pair: -int(pair.num_inliers or 0))
    for pair in pairs[:MAX_PAIRS_SHOWN]:
        other = pair.image2 if pair.image1 == name else pair.image1
        lines.append(f"  {other}: {_described(pair)}")
    if len(pairs) > MAX_PAIRS_SHOWN:
        lines.append(f"  and {len(pairs) - MAX_PAIRS_SHOWN} more in {PAIRS_NAME}")
    return lines


def explain_pair(tables: VerdictTables, name1: str, name2: str) -> list[str]:
    """Describe a pair and its two images.

    Raises
    ------
    DataFileError
        The tables hold no such image.
    """
    images = [_image(tables, name) for name in (name1, name2)]
    found = [pair for pair in tables.pairs if {pair.image1, pair.image2} == {name1, name2}]
    lines = [f"{name1} and {name2}: {_described(pair)}" for pair in found]
    lines += [f"  {EdgeVerdict.reason_of(pair.verdict)}" for pair in found]
    if not found:
        lines = [f"{name1} and {name2}: no verified pair; too few of their features match, or they were not compared"]
    for row in images:
        lines.append(f"  {row.image}: " + (f"in model {row.model}" if row.model else f"not registered, {row.verdict}"))
    return lines


def _image(tables: VerdictTables, name: str) -> ImageRow:
    for row in tables.images:
        if row.image == name:
            return row
    near = get_close_matches(name, [row.image for row in tables.images], n=3, cutoff=0.4)
    hint = f"did you mean {', '.join(near)}?" if near else f"{IMAGES_NAME} lists them"
    raise DataFileError(f"no image {name!r} among the {len(tables.images)} of this job; {hint}")


def _agreement(tables: VerdictTables, model: str) -> str:
    """Clause on the share of a model's own pairs and inlier matches that agree with it."""
    inside = {row.image for row in tables.images if row.model == model}
    pairs = [p for p in tables.pairs if p.rotation_error_deg and {p.image1, p.image2} <= inside]
    if not pairs:
        return ""
    agreeing = [p for p in pairs if float(p.rotation_error_deg) <= MAX_ROTATION_DEG]
    matches = sum(int(p.num_inliers or 1) for p in agreeing) / sum(int(p.num_inliers or 1) for p in pairs)
    return (
        f"; {matches:.1%} of the inlier matches and {len(agreeing)} of {len(pairs)} pairs agree with it within"
        f" {MAX_ROTATION_DEG:g}°"
    )


def _described(pair: PairRow) -> str:
    parts = [pair.verdict]
    if pair.num_inliers:
        parts.append(f"{pair.num_inliers} verified matches")
    if pair.rotation_error_deg:
        parts.append(f"rotation {pair.rotation_error_deg}° off the model")
    if pair.direction_error_deg:
        parts.append(f"direction {pair.direction_error_deg}° off the model")
    if pair.sigmas:
        parts.append(f"{pair.sigmas} standard deviations")
    return ", ".join(parts)


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3f}"
