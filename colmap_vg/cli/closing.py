"""What a job's end says on the terminal: what came out, whether to trust it, and what was left out and why."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from colmap_vg.jobs.summary import georeference_line
from colmap_vg.scene.verdicts import ImageVerdict, SolutionStatus

MAX_REASONS, MAX_NAMES = 3, 3
"""Number of reasons for which images were left out, and of names for each, that are told."""


def closing_lines(summary: Mapping[str, Any], output_path: Path) -> list[str]:
    """Lines on the models, their agreement with the pairs, and the images that are in none.

    Parameters
    ----------
    summary : mapping
        Content of ``summary.json``.
    output_path : Path
        The job's folder, which the hint at `explain` names.

    Returns
    -------
    list of str
    """
    images = summary["images"]
    lines = []
    for model in summary["models"]:
        lines.append(_model_line(model, images["num_images"]))
        if model.get("georeference"):
            lines.append(georeference_line(model["georeference"]))
    status = summary["status"]
    if status not in (SolutionStatus.SOLVED, SolutionStatus.PARTIAL):
        lines.append(f"{status}: {SolutionStatus.reason_of(status)}")
    by_reason: dict[str, list[str]] = {}
    for name, verdict in images["left_out"].items():
        by_reason.setdefault(verdict, []).append(name)
    reasons = sorted(by_reason.items(), key=lambda item: (-len(item[1]), item[0]))
    for verdict, names in reasons[:MAX_REASONS]:
        lines.append(f"{len(names)} left out ({_names(names)}): {ImageVerdict.reason_of(verdict)}")
    if len(reasons) > MAX_REASONS:
        others, count = sum(len(names) for _, names in reasons[MAX_REASONS:]), len(reasons) - MAX_REASONS
        lines.append(f"{others} left out for {count} other reason{'s' if count > 1 else ''}")
    if reasons:
        lines.append(f"all reasons: colmap-vg explain --output_path {output_path}")
    return lines


def _model_line(model: Mapping[str, Any], num_images: int) -> str:
    agreement = model["agreement"]
    size = f"{model['num_images']} of {num_images} images, {model['num_points']} points"
    error = f"mean reprojection error {model['mean_reprojection_error_px']:.2f} px"
    matches, pairs = 100 * agreement["inliers"], 100 * agreement["pairs"]
    return f"{model['path']}: {size}, {error}, {matches:.1f} % of the matches and {pairs:.0f} % of the pairs agree"


def _names(names: list[str]) -> str:
    shown = ", ".join(repr(name) if not name.isprintable() else name for name in sorted(names)[:MAX_NAMES])
    return shown if len(names) <= MAX_NAMES else f"{shown}, ..."
