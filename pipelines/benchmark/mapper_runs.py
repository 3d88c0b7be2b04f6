"""Mappers side by side on one database: alternating runs in fresh processes, and what they took, reached and missed."""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from paper.markdown import markdown_table

from benchmark.fresh_process import result_of
from colmap_vg.errors import ColmapVgError, OptionError
from colmap_vg.events import StageEvent, peak_memory_mib
from colmap_vg.geometry.similarity import align_positions

Array = NDArray[np.float64]
Mapper = Literal["ours", "global", "incremental"]
MAPPERS: tuple[Mapper, ...] = get_args(Mapper)


@dataclass(frozen=True)
class MapperRun:
    """One run of a mapper.

    Attributes
    ----------
    mapper : str
    seconds : float
        Wall time from database to written model; imports do not count.
    peak_memory_mib : float
    num_images, num_registered, num_points : int
        Of the largest model.
    mean_error : float or None
        Mean distance to the true centres after the best similarity, in their unit; None without truth.
    stages : tuple of (str, float, float)
        Name, seconds and the process's peak memory in MiB, for ours.
    """

    mapper: str
    seconds: float
    peak_memory_mib: float
    num_images: int
    num_registered: int
    num_points: int
    mean_error: float | None
    stages: tuple[tuple[str, float, float], ...] = ()


def read_centers(path: Path) -> dict[str, Array]:
    """True projection centres by image name: the last three of twelve numbers behind each name; # begins a comment."""
    centers = {}
    for line in path.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            name, *values = line.rsplit(maxsplit=12)
            centers[name] = np.array(values[-3:], dtype=np.float64)
    return centers


def run_mapper(mapper: Mapper, database_path: Path, truth_path: Path | None = None) -> MapperRun:
    """Run a mapper in this process, on a copy of the database; models go to a folder that is removed.

    Raises
    ------
    OptionError
        Unknown mapper.
    ColmapVgError
        It made no model.
    """
    import time

    import pycolmap

    if mapper not in MAPPERS:
        raise OptionError(f"no mapper {mapper!r}; choose one of {', '.join(MAPPERS)}")
    stages: list[tuple[str, float, float]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = folder / "database.db"
        shutil.copyfile(database_path, database)
        output = folder / "models"
        output.mkdir()
        run = _callable(mapper, stages)
        start = time.perf_counter()
        models = run(database, folder, output)
        seconds = time.perf_counter() - start
        memory = peak_memory_mib()
        if not models:
            raise ColmapVgError(f"{mapper}: no model of {database_path}")
        model = max(models.values(), key=lambda m: m.num_reg_images())
        with pycolmap.Database.open(database) as opened:
            num_images = opened.num_images()
    centers = {model.image(i).name: model.image(i).projection_center() for i in sorted(model.reg_image_ids())}
    error = None
    if truth_path is not None:
        truth = read_centers(truth_path)
        known = [n for n in centers if n in truth]
        found, true = np.array([centers[n] for n in known]), np.array([truth[n] for n in known])
        error = float(align_positions(found, true)[0].mean()) if len(known) >= 3 else None
    return MapperRun(mapper, seconds, memory, num_images, len(centers), model.num_points3D(), error, tuple(stages))


def _callable(mapper: Mapper, stages: list[tuple[str, float, float]]) -> Callable[[Path, Path, Path], dict[int, Any]]:
    import pycolmap

    import colmap_vg

    def finished(event: StageEvent) -> None:
        if event.state == "finished":
            stages.append((event.stage, event.seconds, peak_memory_mib()))

    def ours(database: Path, _images: Path, output: Path) -> dict[int, Any]:
        return dict(colmap_vg.view_graph_mapping(database, None, output, on_event=finished))

    peers: dict[str, Callable[[Path, Path, Path], dict[int, Any]]] = {
        "ours": ours,
        "global": pycolmap.global_mapping,
        "incremental": pycolmap.incremental_mapping,
    }
    return peers[mapper]


def alternate(
    database_path: Path,
    truth_path: Path | None,
    mappers: Sequence[Mapper],
    num_runs: int,
    on_run: Callable[[MapperRun], None] | None = None,
) -> list[MapperRun]:
    """Runs of all mappers in turn, `num_runs` times, each in a fresh process.

    Raises
    ------
    ColmapVgError
        A run failed.
    """
    runs = []
    for _ in range(num_runs):
        for mapper in mappers:
            arguments = [mapper, str(database_path), str(truth_path or "")]
            run = MapperRun(**result_of(__name__, arguments, f"{mapper} on {database_path}"))
            runs.append(run)
            if on_run is not None:
                on_run(run)
    return runs


def compared(runs: Sequence[MapperRun]) -> str:
    """Markdown of medians with spread, ratios to ours in the same run, and the stages of ours."""
    by_mapper = {m: [r for r in runs if r.mapper == m] for m in dict.fromkeys(r.mapper for r in runs)}
    ours = by_mapper.get("ours", [])
    rows = []
    for mapper, own in by_mapper.items():
        seconds = [r.seconds for r in own]
        errors = [r.mean_error for r in own if r.mean_error is not None]
        ratios = [a.seconds / b.seconds for a, b in zip(ours, own, strict=False)]
        rows.append(
            [
                mapper,
                str(len(own)),
                f"{median(seconds):.2f} ({min(seconds):.2f}-{max(seconds):.2f})",
                f"{median(r.peak_memory_mib for r in own):.0f}",
                f"{min(r.num_registered for r in own)}/{own[0].num_images}",
                f"{median(r.num_points for r in own):.0f}",
                f"{median(errors):.4g}" if errors else "",
                f"{median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})" if ratios else "",
            ]
        )
    header = ["mapper", "runs", "seconds", "peak MiB", "registered", "points", "mean error", "time of ours / its"]
    text = markdown_table(header, rows)
    if ours:
        stages = [
            [name, f"{median({s: t for s, t, _ in r.stages}[name] for r in ours):.2f}", f"{memory:.0f}"]
            for name, _, memory in ours[0].stages
        ]
        text += "\n" + markdown_table(["stage of ours", "seconds", "peak MiB so far"], stages)
    return text


def summarized(runs: Mapping[str, Sequence[MapperRun]]) -> tuple[str, dict[str, dict[str, float]]]:
    """Ratios of ours to COLMAP's mappers on several databases, with their geometric means.

    The error is compared with the lower one of the mappers that registered most images.

    Parameters
    ----------
    runs : mapping of str to sequence of MapperRun
        By database, from :func:`alternate`.

    Returns
    -------
    text : str
        Markdown; empty without ours or without others.
    ratios : dict of str to dict of str to float
        By kind of ratio, then by database.
    """
    ratios: dict[str, dict[str, float]] = {}
    for database, every in runs.items():
        ours = [r for r in every if r.mapper == "ours"]
        peers = {m: [r for r in every if r.mapper == m] for m in MAPPERS[1:]}
        peers = {m: own for m, own in peers.items() if own}
        if not ours or not peers:
            continue
        for mapper, own in peers.items():
            times = [a.seconds / b.seconds for a, b in zip(ours, own, strict=False)]
            ratios.setdefault(f"time / {mapper}", {})[database] = median(times)
        most = max(r.num_registered for own in peers.values() for r in own)
        complete = [own for own in peers.values() if min(r.num_registered for r in own) == most]
        errors = [_median_error(own) for own in (ours, *complete)]
        if None not in errors and len(errors) > 1:
            ratios.setdefault("error / better", {})[database] = errors[0] / min(errors[1:])
    kinds = list(ratios)
    rows = [
        [name, *(f"{ratios[k][name]:.3f}" if name in ratios[k] else "" for k in kinds)]
        for name in runs
        if any(name in ratios[k] for k in kinds)
    ]
    if len(rows) > 1:
        means = [f"{np.exp(np.mean(np.log(list(ratios[k].values())))):.3f}" for k in kinds]
        rows.append(["geometric mean", *means])
    return (markdown_table(["database", *kinds], rows) if rows else ""), ratios


def _median_error(runs: Sequence[MapperRun]) -> Any:
    errors = [r.mean_error for r in runs]
    return None if None in errors else median(errors)


def main(arguments: Sequence[str]) -> None:
    """Run one mapper and write the run as JSON: MAPPER DATABASE TRUTH_OR_EMPTY RESULT."""
    mapper, database, truth, result = arguments
    if mapper not in MAPPERS:
        raise OptionError(f"no mapper {mapper!r}; choose one of {', '.join(MAPPERS)}")
    run = run_mapper(mapper, Path(database), Path(truth) if truth else None)
    Path(result).write_text(json.dumps(asdict(run)))


if __name__ == "__main__":
    main(sys.argv[1:])
