"""From photographs to a model, ours beside COLMAP's default way, in alternating runs in fresh processes.

COLMAP's way is extraction, exhaustive matching and incremental mapping, with the same camera model, features and
verification. On a machine that others use, too, compare processor seconds.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

import numpy as np
from paper.markdown import markdown_table

from benchmark.fresh_process import result_of
from benchmark.mapper_runs import read_centers
from colmap_vg.errors import ColmapVgError, OptionError
from colmap_vg.events import StageEvent
from colmap_vg.geometry.similarity import align_positions

Way = Literal["ours", "colmap"]
WAYS: tuple[Way, ...] = get_args(Way)
STAGES = ("features", "matching", "mapping")


@dataclass(frozen=True)
class PhotographRun:
    """One way from a folder of photographs to a model.

    Attributes
    ----------
    way : str
    stages : tuple of (str, float, float)
        Name, wall and processor seconds of features, matching and mapping.
    num_pairs, num_verified_pairs, num_inlier_matches : int
        Of the database.
    num_images, num_registered, num_points : int
        Of the largest model.
    mean_error : float or None
        Mean distance to the true centres after the best similarity, in their unit; None without truth.
    """

    way: str
    stages: tuple[tuple[str, float, float], ...]
    num_pairs: int
    num_verified_pairs: int
    num_inlier_matches: int
    num_images: int
    num_registered: int
    num_points: int
    mean_error: float | None

    @property
    def seconds(self) -> float:
        """Wall time of all stages."""
        return sum(wall for _, wall, _ in self.stages)

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all stages."""
        return sum(cpu for _, _, cpu in self.stages)


class _Clock:
    """Wall and processor seconds since the last look; children that have ended count."""

    def __init__(self) -> None:
        self._last = self._now()

    def lap(self) -> tuple[float, float]:
        now, last = self._now(), self._last
        self._last = now
        return now[0] - last[0], now[1] - last[1]

    @staticmethod
    def _now() -> tuple[float, float]:
        times = os.times()
        return time.perf_counter(), times.user + times.system + times.children_user + times.children_system


def run_photographs(way: Way, image_path: Path, truth_path: Path | None, quality: str = "high") -> PhotographRun:
    """Go one way in this process; database and models go to a folder that is removed.

    Raises
    ------
    OptionError
        Unknown way or quality.
    ColmapVgError
        No model was made.
    """
    import pycolmap

    if way not in WAYS:
        raise OptionError(f"no way {way!r}; choose one of {', '.join(WAYS)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stages, models = (_ours if way == "ours" else _colmap)(image_path, folder, quality)
        if not models:
            raise ColmapVgError(f"{way}: no model of {image_path}")
        with pycolmap.Database.open(folder / "database.db") as database:
            inliers = database.read_two_view_geometry_num_inliers()[1]
            num_images, num_pairs = database.num_images(), database.num_matched_image_pairs()
    model = max(models.values(), key=lambda m: m.num_reg_images())
    centers = {model.image(i).name: model.image(i).projection_center() for i in sorted(model.reg_image_ids())}
    error = None
    if truth_path is not None:
        truth = read_centers(truth_path)
        known = [n for n in centers if n in truth]
        found, true = np.array([centers[n] for n in known]), np.array([truth[n] for n in known])
        error = float(align_positions(found, true)[0].mean()) if len(known) >= 3 else None
    verified = [int(count) for count in inliers if count]
    return PhotographRun(
        way=way,
        stages=tuple((stage, *stages[stage]) for stage in STAGES),
        num_pairs=num_pairs,
        num_verified_pairs=len(verified),
        num_inlier_matches=sum(verified),
        num_images=num_images,
        num_registered=len(centers),
        num_points=model.num_points3D(),
        mean_error=error,
    )


Stages = dict[str, tuple[float, float]]


def _ours(image_path: Path, folder: Path, quality: Any) -> tuple[Stages, dict[int, Any]]:
    import colmap_vg

    stages, clock = dict.fromkeys(STAGES, (0.0, 0.0)), _Clock()

    def finished(event: StageEvent) -> None:
        if event.state == "finished":
            name = {"photographs": "features"}.get(event.stage, event.stage)
            add(name if name in stages else "mapping")

    def add(name: str) -> None:
        wall, cpu = clock.lap()
        stages[name] = (stages[name][0] + wall, stages[name][1] + cpu)

    features = colmap_vg.FeatureOptions.of_quality(quality)
    models = colmap_vg.image_folder_mapping(image_path, folder, features, on_event=finished)
    add("mapping")
    return stages, dict(models)


def _colmap(image_path: Path, folder: Path, quality: Any) -> tuple[Stages, dict[int, Any]]:
    import pycolmap

    import colmap_vg

    ours = colmap_vg.FeatureOptions.of_quality(quality)
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.use_gpu = matching.use_gpu = False
    extraction.max_image_size = ours.max_image_size
    extraction.sift.max_num_features = ours.max_num_features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = ours.camera_model
    database, output, stages, clock = folder / "database.db", folder / "models", {}, _Clock()
    output.mkdir()
    pycolmap.extract_features(database, image_path, reader_options=reader, extraction_options=extraction)
    stages["features"] = clock.lap()
    pycolmap.match_exhaustive(database, matching)
    stages["matching"] = clock.lap()
    models = pycolmap.incremental_mapping(database, image_path, output)
    stages["mapping"] = clock.lap()
    return stages, dict(models)


def alternate_ways(
    image_path: Path,
    truth_path: Path | None,
    num_runs: int,
    quality: str = "high",
    on_run: Callable[[PhotographRun], None] | None = None,
) -> list[PhotographRun]:
    """Both ways in turn, `num_runs` times, each in a fresh process.

    Raises
    ------
    ColmapVgError
        A run failed.
    """
    runs = []
    for _ in range(num_runs):
        for way in WAYS:
            arguments = [way, str(image_path), str(truth_path or ""), quality]
            run = PhotographRun(**result_of(__name__, arguments, f"{way} on {image_path}"))
            runs.append(run)
            if on_run is not None:
                on_run(run)
    return runs


def compared_ways(runs: Sequence[PhotographRun]) -> str:
    """Markdown of medians of both ways, and of ours over COLMAP's in the same turn."""
    rows = []
    for way in dict.fromkeys(run.way for run in runs):
        own = [run for run in runs if run.way == way]
        errors = [run.mean_error for run in own if run.mean_error is not None]
        seconds = [f"{median(run.stages[k][1] for run in own):.1f}" for k in range(len(STAGES))]
        cpu = [f"{median(run.stages[k][2] for run in own):.1f}" for k in range(len(STAGES))]
        rows.append(
            [
                way,
                *(f"{wall} ({processor})" for wall, processor in zip(seconds, cpu, strict=True)),
                f"{median(r.seconds for r in own):.1f} ({median(r.cpu_seconds for r in own):.1f})",
                f"{own[0].num_verified_pairs}/{own[0].num_pairs}",
                str(own[0].num_inlier_matches),
                f"{min(r.num_registered for r in own)}/{own[0].num_images}",
                f"{median(errors):.4g}" if errors else "",
            ]
        )
    pairs = list(zip(*([r for r in runs if r.way == way] for way in WAYS), strict=False))
    if pairs:
        rows.append(["ours / colmap", *_ratios(pairs)])
    header = ["way", *(f"{stage}, s (CPU s)" for stage in STAGES), "all, s (CPU s)", "pairs verified/matched"]
    return markdown_table([*header, "inlier matches", "registered", "mean error"], rows)


def _ratios(pairs: Sequence[tuple[PhotographRun, ...]]) -> list[str]:
    def ratio(value: Callable[[PhotographRun], float]) -> str:
        return f"{median(value(ours) / max(value(theirs), 1e-9) for ours, theirs in pairs):.3f}"

    stages = [
        f"{ratio(lambda run, k=k: run.stages[k][1])} ({ratio(lambda run, k=k: run.stages[k][2])})"  # type: ignore[misc]
        for k in range(len(STAGES))
    ]
    errors = all(run.mean_error is not None for turn in pairs for run in turn)
    return [
        *stages,
        f"{ratio(lambda run: run.seconds)} ({ratio(lambda run: run.cpu_seconds)})",
        ratio(lambda run: run.num_pairs),
        ratio(lambda run: run.num_inlier_matches),
        ratio(lambda run: run.num_registered),
        ratio(lambda run: run.mean_error or 0.0) if errors else "",
    ]


def main(arguments: Sequence[str]) -> None:
    """Go one way and write the run as JSON: WAY IMAGES TRUTH_OR_EMPTY QUALITY RESULT."""
    way, images, truth, quality, result = arguments
    if way not in WAYS:
        raise OptionError(f"no way {way!r}; choose one of {', '.join(WAYS)}")
    run = run_photographs(way, Path(images), Path(truth) if truth else None, quality)
    Path(result).write_text(json.dumps(asdict(run)))


if __name__ == "__main__":
    main(sys.argv[1:])
