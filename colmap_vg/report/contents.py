"""Gather what the report shows from the files of a finished job."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import DatabaseError
from colmap_vg.jobs.image_folder import DATABASE_NAME
from colmap_vg.jobs.output_folder import existing_models
from colmap_vg.jobs.summary import given_path, read_summary
from colmap_vg.jobs.verdict_tables import ImageRow, PairRow, read_tables
from colmap_vg.report.matches import MAX_MATCHES, pair_matches
from colmap_vg.report.models import MAX_POINTS, ModelView, model_view, read_model
from colmap_vg.report.thumbnails import MANY, MAX_THUMBNAILS, PREVIEW_SIDE, SIDE, SMALL_SIDE, thumbnails
from colmap_vg.scene.verdicts import USED_EDGES

MAX_PAIRS, MAX_MODELS, NUM_WORST = 20_000, 20, 24
"""Maximum number of pairs and of models shown, and number of pairs whose matches are shown."""


@dataclass(frozen=True, eq=False)
class Contents:
    """What the report shows.

    Attributes
    ----------
    summary : dict
        ``summary.json``.
    images : tuple of ImageRow
    pairs : tuple of PairRow
        The worst ones, if there are too many to show.
    models : tuple of ModelView
    photographs : tuple of str
        For each image a data URI; empty without a photograph.
    matches : mapping of int to array
        For some rows of pairs their inlier matches, see `pair_matches`.
    notes : tuple of str
        Sentences on what was subsampled or is missing.
    """

    summary: dict[str, Any]
    images: tuple[ImageRow, ...]
    pairs: tuple[PairRow, ...]
    models: tuple[ModelView, ...]
    photographs: tuple[str, ...]
    matches: Mapping[int, NDArray[np.float64]]
    notes: tuple[str, ...]


def gather(output_path: Path, image_path: Path | None = None, database_path: Path | None = None) -> Contents:
    """Gather what the report shows.

    Parameters
    ----------
    output_path : Path
        Folder of a finished job.
    image_path, database_path : Path, optional
        Folder of the photographs, and database; by default those that the summary names.

    Raises
    ------
    ColmapVgError
        The summary, a table or a model is missing or damaged.
    """
    summary, tables = read_summary(output_path), read_tables(output_path)
    notes: list[str] = []
    rows = {row.image: index for index, row in enumerate(tables.images)}
    models = _models(output_path, rows, notes)
    pairs = _shown_pairs(tables.pairs, notes)
    database_path = database_path or given_path(summary, "database_path", output_path / DATABASE_NAME)
    matches = _worst_matches(database_path, pairs, notes)
    previews = {rows[name] for k in matches for name in (pairs[k].image1, pairs[k].image2) if name in rows}
    image_path = image_path or given_path(summary, "image_path", output_path / "images")
    photographs = _photographs(image_path, tables.images, previews, notes)
    return Contents(summary, tables.images, pairs, models, photographs, matches, tuple(notes))


def error_deg(pair: PairRow) -> float:
    """Rotation error of a pair in degrees; -1 where it is unknown."""
    return float(pair.rotation_error_deg or -1.0)


def _models(output_path: Path, rows: Mapping[str, int], notes: list[str]) -> tuple[ModelView, ...]:
    folders = [folder for folder in existing_models(output_path) if folder != output_path]
    if len(folders) > MAX_MODELS:
        notes.append(f"The first {MAX_MODELS} of {len(folders)} models are shown.")
    read = [(folder.name, read_model(folder)) for folder in folders[:MAX_MODELS]]
    total = sum(model.num_points3D() for _, model in read)
    share = min(MAX_POINTS / max(total, 1), 1.0)
    views = tuple(model_view(name, model, rows, int(share * model.num_points3D())) for name, model in read)
    if share < 1.0:
        shown = sum(len(view.points) for view in views)
        notes.append(f"The 3-D view shows {shown:,} of {total:,} points, evenly chosen.")
    far = sum(view.num_far for view in views)
    if far:
        notes.append(f"The 3-D view does not show {far:,} points far from the scene.")
    return views


def _shown_pairs(pairs: Sequence[PairRow], notes: list[str]) -> tuple[PairRow, ...]:
    if len(pairs) <= MAX_PAIRS:
        return tuple(pairs)
    notes.append(
        f"{MAX_PAIRS:,} of {len(pairs):,} pairs are shown: all pairs that were not used, as far as there is"
        " room, and of the others evenly spread ones. pairs.csv lists all."
    )
    unused = [index for index, pair in enumerate(pairs) if pair.verdict not in USED_EDGES]
    used = [index for index, pair in enumerate(pairs) if pair.verdict in USED_EDGES]
    room = max(MAX_PAIRS - len(unused), MAX_PAIRS // 2)
    chosen = _spread(used, room)
    chosen += _spread(unused, MAX_PAIRS - len(chosen))
    return tuple(pairs[index] for index in sorted(chosen))


def _spread(rows: list[int], count: int) -> list[int]:
    """Evenly spread rows, at most `count` of them."""
    if len(rows) <= count:
        return rows
    return [rows[k] for k in np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _worst_matches(
    database_path: Path | None, pairs: Sequence[PairRow], notes: list[str]
) -> dict[int, NDArray[np.float64]]:
    """Matches of the pairs with the largest rotation errors, half of them pairs that were used."""
    if database_path is None:
        notes.append("Without the database, no matches are shown.")
        return {}
    worst = sorted(range(len(pairs)), key=lambda k: -error_deg(pairs[k]))
    used = [k for k in worst if pairs[k].verdict in USED_EDGES][: NUM_WORST // 2]
    chosen = used + [k for k in worst if k not in used][: NUM_WORST - len(used)]
    try:
        found = pair_matches(database_path, [(pairs[k].image1, pairs[k].image2) for k in chosen])
    except DatabaseError as error:
        notes.append(f"No matches are shown: {error}.")
        return {}
    matches = {k: match for k, match in zip(chosen, found, strict=True) if match is not None}
    if len(matches) < len(pairs):
        notes.append(
            f"Matches are shown for the {len(matches)} pairs with the largest rotation errors, half of them used ones;"
            f" at most {MAX_MATCHES} per pair."
        )
    return matches


def _photographs(
    image_path: Path | None, images: Sequence[ImageRow], previews: set[int], notes: list[str]
) -> tuple[str, ...]:
    found = [""] * len(images)
    if image_path is None:
        notes.append("Without the folder of photographs (--image_path), no thumbnails are shown.")
        return tuple(found)
    chosen = sorted({*_spread(list(range(len(images))), MAX_THUMBNAILS), *previews})
    side = SIDE if len(images) <= MANY else SMALL_SIDE
    sides = [PREVIEW_SIDE if index in previews else side for index in chosen]
    for index, made in zip(chosen, thumbnails(image_path, [images[k].image for k in chosen], sides), strict=True):
        found[index] = made
    if len(chosen) < len(images):
        notes.append(f"Thumbnails are shown for {len(chosen)} of {len(images)} images.")
    missing = sum(not found[index] for index in chosen)
    if missing:
        notes.append(f"{missing} photographs are missing or cannot be read.")
    return tuple(found)
