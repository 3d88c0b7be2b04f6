"""``summary.json``: options, stages, times and results of a job, with the reasons for removed images and pairs."""

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_vg._version import __version__
from colmap_vg.errors import OutputError
from colmap_vg.events import StageRecord
from colmap_vg.jobs.atomic_write import atomic_write

if TYPE_CHECKING:
    import pycolmap

FILE_NAME = "summary.json"


def job_summary(
    verb: str, options: Mapping[str, object], records: Sequence[StageRecord], warnings: Sequence[str]
) -> dict[str, object]:
    """Entries of the summary that all verbs share: verb, version, options, stages and warnings."""
    return {
        "verb": verb,
        "version": __version__,
        "options": {name: plain(value) for name, value in options.items()},
        "stages": [asdict(record) for record in records],
        "seconds": sum(record.seconds for record in records),
        "peak_memory_mib": max((record.peak_memory_mib for record in records), default=0.0),
        "warnings": list(warnings),
    }


def image_summary(names: Iterable[str], verdicts: Iterable[str], registered: Iterable[bool]) -> dict[str, object]:
    """Names of the registered images, and the verdict of each image that is not registered."""
    rows = list(zip(names, verdicts, registered, strict=True))
    left_out = {name: str(verdict) for name, verdict, is_registered in rows if not is_registered}
    return {
        "num_images": len(rows),
        "num_registered": len(rows) - len(left_out),
        "registered": sorted(name for name, _, is_registered in rows if is_registered),
        "left_out": left_out,
    }


def edge_summary(verdicts: Iterable[str], kept: Iterable[bool]) -> dict[str, object]:
    """Number of kept edges, and of dropped edges by verdict."""
    rows = list(zip(verdicts, kept, strict=True))
    dropped = Counter(str(verdict) for verdict, is_kept in rows if not is_kept)
    return {
        "num_edges": len(rows),
        "num_kept": len(rows) - dropped.total(),
        "dropped": dict(dropped.most_common()),
    }


def model_summary(path: Path, model: "pycolmap.Reconstruction") -> dict[str, object]:
    """Size and mean reprojection error of a model."""
    model.update_point_3d_errors()  # compute_mean_reprojection_error reads stored errors
    return {
        "path": str(path),
        "num_images": model.num_reg_images(),
        "num_points": model.num_points3D(),
        "num_observations": model.compute_num_observations(),
        "mean_track_length": model.compute_mean_track_length(),
        "mean_reprojection_error_px": model.compute_mean_reprojection_error(),
    }


def georeference_line(told: Mapping[str, Any]) -> str:
    """Sentence on the frame of a georeferenced model, and on the measured positions.

    >>> georeference_line({"origin": [47.3, 8.5, 440.0], "sigmas": [3.1, 3.1, 4.8], "outliers": ["a"],
    ...                    "residuals": {"a": [], "b": [], "c": [], "d": []}})
    'metres east, north and up of 47.3, 8.5 (WGS84, height 440 m); positions measured to 3.1, 3.1, 4.8; 1 of 4 is wrong'
    """
    origin, wrong, count = told["origin"], len(told["outliers"]), len(told["residuals"])
    frame = "in the frame of the measured positions"
    if origin is not None:
        frame = f"metres east, north and up of {origin[0]}, {origin[1]} (WGS84, height {origin[2]:g} m)"
    precision = ", ".join(f"{sigma:.2g}" for sigma in told["sigmas"])
    return f"{frame}; positions measured to {precision}; {wrong} of {count} {'is' if wrong == 1 else 'are'} wrong"


def write_summary(output_path: Path, content: Mapping[str, object]) -> None:
    """Write ``summary.json`` atomically.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    atomic_write(output_path / FILE_NAME, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_summary(output_path: Path) -> dict[str, Any]:
    """Read the summary of a finished job.

    Raises
    ------
    OutputError
        There is no summary, or it is damaged.
    """
    path = output_path / FILE_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}; run the job again") from error
    except ValueError as error:
        raise damaged_summary(output_path) from error
    if not isinstance(content, dict):
        raise damaged_summary(output_path)
    return content


def given_path(summary: Mapping[str, Any], option: str, beside: Path) -> Path | None:
    """Return the path that a finished job was given, or the one in its output folder; None where neither exists."""
    options = summary.get("options")
    given = options.get(option) if isinstance(options, dict) else None
    paths = [Path(given)] if isinstance(given, str) else []
    return next((path for path in [*paths, beside] if path.exists()), None)


def damaged_summary(output_path: Path) -> OutputError:
    """Return the error for a summary that lacks what this version writes."""
    return OutputError(f"{output_path / FILE_NAME} is damaged or was written by another version: run the job again")


def told_bridges(output_path: Path) -> list[str]:
    """Read the sentences on the links between and within models from the summary of a finished job.

    Raises
    ------
    OutputError
        There is no summary, or it is damaged.
    """
    try:
        return [str(bridge["told"]) for bridge in read_summary(output_path)["bridges"]]
    except (KeyError, TypeError) as error:
        raise damaged_summary(output_path) from error


def plain(value: object) -> object:
    """Convert a value to JSON's types; paths become absolute, for readers that start elsewhere."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(item) for name, item in asdict(value).items()}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return plain(value.value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(Path(value).absolute()) if isinstance(value, os.PathLike) else str(value)
