"""Speed, memory and accuracy beside COLMAP's mappers: ``python pipelines/benchmark.py WHAT --output_path OUT``.

``mapping``: ours, global and incremental mapping in turn on databases (folders with database.db and, when known,
ground_truth.txt). ``graphs``: the default solve without matches beside rotation averaging alone, on the topologies of
1DSfM. ``growth``: synthetic databases and graphs of rising size, with fitted exponents. ``photographs``: from folders
of photographs to models, ours and COLMAP's default way in turn. Writes Markdown, JSON and SVG.
Times differ from machine to machine and from hour to hour: compare ratios, and exponents.
"""

import argparse
import json
import os
import platform
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np
from benchmark.growth import Timing, growth_table, looped_scene, timed_rotation_averaging, timed_solve
from benchmark.mapper_runs import MAPPERS, MapperRun, alternate, compared, summarized
from benchmark.photograph_runs import WAYS, PhotographRun, alternate_ways, compared_ways
from paper.markdown import markdown_table
from paper.plots import lines_svg, ratios_svg
from paper.scenes import set_conditions, simulated_scene, topology_sets

import colmap_vg
from colmap_vg.demo.photographs import render_photographs
from colmap_vg.options import Quality
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import SyntheticViews, synthetic_views

QUICK_IMAGES, FULL_IMAGES = (30, 60), (50, 100, 200, 500, 1000, 2000)
QUICK_EDGES, FULL_EDGES = (2_000, 8_000), (20_000, 100_000, 300_000, 1_000_000)
QUICK_LIMIT = 1.5
"""With --quick, ours may take so many times what global mapping takes: small problems hardly tell them apart."""


def main() -> None:
    """Run the pipeline."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["mapping", "graphs", "growth", "photographs"])
    parser.add_argument("--output_path", type=Path, required=True, help="receives report.md, report.json and plots")
    parser.add_argument("--databases", type=Path, nargs="+", help="folders with database.db; default: synthetic ones")
    parser.add_argument("--photographs", type=Path, nargs="+", help="folders with images/; default: rendered ones")
    parser.add_argument("--quality", choices=get_args(Quality), default="high", help="of features, for photographs")
    parser.add_argument("--mappers", nargs="+", choices=MAPPERS, default=list(MAPPERS))
    parser.add_argument("--runs", type=int, default=3, help="of each mapper on each database")
    parser.add_argument("--topology", type=Path, help="folder of .mat adjacencies, for graphs")
    parser.add_argument("--sets", nargs="+", help="of the topology; default: all")
    parser.add_argument("--layouts", nargs="+", choices=["street", "ring", "drone"], default=["street", "drone"])
    parser.add_argument("--sizes", type=int, nargs="+", help="images of synthetic databases, or to render")
    parser.add_argument(
        "--noises", type=float, nargs="+", default=[0.5], help="of synthetic keypoints, px, for mapping"
    )
    parser.add_argument("--edges", type=int, nargs="*", help="edges of synthetic graphs, for growth")
    parser.add_argument("--quick", action="store_true", help="small problems; fails by ratios only")
    arguments = parser.parse_args()
    if arguments.runs < 1:
        parser.error("--runs must be at least 1")
    if arguments.what == "graphs" and arguments.topology is None:
        parser.error("graphs needs --topology")
    arguments.output_path.mkdir(parents=True, exist_ok=True)
    job = {"mapping": mapping, "graphs": graphs, "growth": growth, "photographs": photographs}[arguments.what]
    try:
        text, data, plots, failed = job(arguments)
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    head = f"# Benchmark: {arguments.what}\n\ncolmap_vg {colmap_vg.__version__}, {machine}\n\n"
    (arguments.output_path / "report.md").write_text(head + text)
    report = {"what": arguments.what, "machine": machine, "version": colmap_vg.__version__, "results": data}
    (arguments.output_path / "report.json").write_text(json.dumps(report, indent=1))
    for name, plot in plots.items():
        (arguments.output_path / f"{name}.svg").write_text(plot)
    print(head + text)
    if failed:
        sys.exit("error: " + "; ".join(failed))


Result = tuple[str, Any, dict[str, str], list[str]]


def mapping(arguments: argparse.Namespace) -> Result:
    """Mappers in turn on each database."""
    with tempfile.TemporaryDirectory() as name:
        folders = arguments.databases
        if not folders:
            sizes = arguments.sizes or ([QUICK_IMAGES[-1]] if arguments.quick else [500])
            folders = [
                synthetic_folder(Path(name), layout, size, noise)
                for layout in arguments.layouts
                for size in sizes
                for noise in arguments.noises
            ]
        text, data, failed = "", {}, []
        every: dict[str, list[MapperRun]] = {}
        for folder in folders:
            truth = folder / "ground_truth.txt"
            runs = alternate(
                folder / "database.db", truth if truth.is_file() else None, arguments.mappers, arguments.runs, show
            )
            text += f"## {folder.name}\n\n{compared(runs)}\n"
            data[folder.name] = [asdict(run) for run in runs]
            every[folder.name] = runs
            if arguments.quick:
                failed += falls_behind(folder.name, runs)
    summary, ratios = summarized(every)
    plots = {"ratios": ratios_svg("Ours over the better mapper of COLMAP", "ratio", ratios)} if ratios else {}
    return f"{summary}\n{text}", data, plots, failed


def falls_behind(name: str, runs: list[MapperRun]) -> list[str]:
    """Sentences of what is worse than it may be, by ratios of the same alternating runs."""
    ours, peers = ([r for r in runs if r.mapper == m] for m in ("ours", "global"))
    if not ours or not peers:
        return []
    ratio = float(np.median([a.seconds / b.seconds for a, b in zip(ours, peers, strict=True)]))
    failed = []
    if ratio > QUICK_LIMIT:
        failed.append(f"{name}: {ratio:.2f} times the time of global mapping")
    if min(r.num_registered for r in ours) < min(r.num_registered for r in peers):
        failed.append(f"{name}: fewer images than global mapping")
    return failed


def graphs(arguments: argparse.Namespace) -> Result:
    """Solving by 2O beside rotation averaging alone."""
    sets = arguments.sets or topology_sets(arguments.topology)
    for name in sets:
        set_conditions(arguments.topology, name)  # says of an unknown set before any work is done
    rows, data = [], []
    for name in sets:
        graph = simulated_scene(arguments.topology, name, 0).graph
        ours, theirs = timed_solve(graph), timed_rotation_averaging(graph)
        data.append({"set": name, "edges": graph.num_edges, "ours": ours, "rotation_averaging": theirs})
        rows.append(
            [name, str(graph.num_images), str(graph.num_edges), f"{ours:.2f}", f"{theirs:.2f}", f"{ours / theirs:.2f}"]
        )
        print(*rows[-1], flush=True)
    header = ["set", "images", "edges", "ours (RS + CLS + 2O), s", "pycolmap's rotation averaging alone, s", "ratio"]
    return markdown_table(header, rows), data, {}, []


def growth(arguments: argparse.Namespace) -> Result:
    """Times over sizes, with exponents."""
    sizes = arguments.sizes or (QUICK_IMAGES if arguments.quick else FULL_IMAGES)
    edges = arguments.edges if arguments.edges is not None else (QUICK_EDGES if arguments.quick else FULL_EDGES)
    series: dict[str, list[Timing]] = {}
    for layout in arguments.layouts:
        for size in sizes:
            with tempfile.TemporaryDirectory() as name:
                folder = synthetic_folder(Path(name), layout, size, 0.5)
                for run in alternate(folder / "database.db", folder / "ground_truth.txt", arguments.mappers, 1, show):
                    key = f"{layout} {run.mapper}"
                    series.setdefault(key, []).append(Timing(key, size, run.seconds))
    text, plots = growth_table(series, "images"), {"databases": plotted("From database to model", "images", series)}
    if edges:
        solves = [Timing("solve", m, timed_solve(looped_scene(max(m // 20, 10), m).graph)) for m in edges]
        text += "\n" + growth_table({"solve without matches": solves}, "edges")
        plots["graphs"] = plotted("Solving graphs without matches", "edges", {"solve": solves})
        series["solve"] = solves
    return text, {name: [asdict(t) for t in own] for name, own in series.items()}, plots, []


def photographs(arguments: argparse.Namespace) -> Result:
    """Both ways from photographs to a model in turn."""
    with tempfile.TemporaryDirectory() as name:
        folders = arguments.photographs
        if not folders:
            sizes = arguments.sizes or ([12] if arguments.quick else [100])
            folders = [rendered_folder(Path(name), size) for size in sizes]
        text, data, failed = "", {}, []
        for folder in folders:
            truth = folder / "ground_truth.txt"
            runs = alternate_ways(
                folder / "images", truth if truth.is_file() else None, arguments.runs, arguments.quality, show_way
            )
            text += f"## {folder.name}\n\n{compared_ways(runs)}\n"
            data[folder.name] = [asdict(run) for run in runs]
            ours, theirs = ([run for run in runs if run.way == way] for way in WAYS)
            if arguments.quick and min(r.num_registered for r in ours) < min(r.num_registered for r in theirs):
                failed.append(f"{folder.name}: fewer images than COLMAP's way")
    return text, data, {}, failed


def rendered_folder(parent: Path, size: int) -> Path:
    """A folder with rendered images and ground_truth.txt."""
    folder = parent / f"rendered-{size}"
    (folder / "images").mkdir(parents=True)
    cameras = render_photographs(folder / "images", num_images=size, num_threads=-1)
    numbers = np.concatenate([cameras.rotations.reshape(-1, 9), cameras.centers], axis=1).tolist()
    rows = zip(cameras.names, numbers, strict=True)
    (folder / "ground_truth.txt").write_text("".join(f"{n} {' '.join(map(repr, row))}\n" for n, row in rows))
    return folder


def plotted(title: str, label: str, series: dict[str, list[Timing]]) -> str:
    """Growth as SVG."""
    return lines_svg(
        title,
        label,
        "seconds",
        {n: (np.array([t.size for t in own]), np.array([t.seconds for t in own])) for n, own in series.items()},
    )


def synthetic_folder(parent: Path, layout: Any, size: int, noise_px: float) -> Path:
    """A folder with database.db and ground_truth.txt of synthetic views."""
    folder = parent / f"{layout}-{size}-{noise_px:g}px"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    views = synthetic_views(layout, size, noise_px=noise_px)
    write_synthetic_database(folder / "database.db", views)
    (folder / "ground_truth.txt").write_text(truth_text(views))
    return folder


def truth_text(views: SyntheticViews) -> str:
    """Name, rotation and centre of each image, one a line."""
    numbers = np.concatenate([views.cam_from_world_rotations.reshape(-1, 9), views.projection_centers], axis=1)
    return "".join(f"{k:05d}.jpg {' '.join(map(repr, row))}\n" for k, row in enumerate(numbers.tolist()))


def show(run: MapperRun) -> None:
    """A line for each finished run."""
    print(f"{run.mapper}: {run.seconds:.1f} s, {run.num_registered}/{run.num_images} images", flush=True)


def show_way(run: PhotographRun) -> None:
    """A line for each finished way."""
    print(f"{run.way}: {run.seconds:.1f} s, {run.num_registered}/{run.num_images} images", flush=True)


if __name__ == "__main__":
    main()
