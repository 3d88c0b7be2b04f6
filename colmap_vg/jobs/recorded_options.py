"""The options of a finished job, from its summary."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from colmap_vg.errors import OptionError
from colmap_vg.jobs.summary import damaged_summary
from colmap_vg.options import MappingOptions, ReadOptions, SolveOptions

Options = TypeVar("Options", ReadOptions, SolveOptions, MappingOptions)


def recorded_options(summary: Mapping[str, Any], output_path: Path) -> MappingOptions:
    """Return the options with which the database of a finished job was mapped.

    Parameters
    ----------
    summary : mapping
        ``summary.json`` of `run`, `mapper`, `solve` or `demo`.
    output_path : Path
        The job's folder, for messages.

    Raises
    ------
    OutputError
        The summary is damaged, or of another version.
    """
    options = summary.get("options")
    if not isinstance(options, dict):
        raise damaged_summary(output_path)
    try:
        mapping = options.get("mapping", {})
        parts = mapping or options
        read = _made(ReadOptions, parts.get("read", {}))
        solve = _made(SolveOptions, parts.get("solve", {}))
        # The demo records its seed only.
        seed = options.get("seed", solve.random_seed)
        return _made(MappingOptions, {"random_seed": seed, **mapping, "read": read, "solve": solve})
    except (AttributeError, TypeError, OptionError) as error:
        raise damaged_summary(output_path) from error


def _made(kind: type[Options], recorded: Mapping[str, Any]) -> Options:
    known = {field.name for field in fields(kind)}
    unknown = sorted(set(recorded) - known)
    if unknown:
        raise OptionError(f"{kind.__name__} has no option {unknown[0]}")
    return kind(**recorded)
