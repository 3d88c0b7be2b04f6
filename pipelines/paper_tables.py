"""Tables and figures of the paper: ``python pipelines/paper_tables.py --topology FOLDER --output_path OUT``.

On 1DSfM folders with truth (``--data FOLDER ...``, each with EGs.txt and gt_bundle.out), or on cameras simulated on the
topologies of real sets (``--topology``). ``--real_edges FOLDER ...`` adds the noise of real edges without truth. Writes
Markdown, CSV and SVG to OUT/tables.
"""

import argparse
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import get_args

from paper.noise_ratios import NUM_RATIO_SEEDS
from paper.position_table import DEFAULT_METHOD, TABLE_METHODS
from paper.real_edges import edge_noise
from paper.scene_reports import SceneJob, SceneReport, measure_or_load
from paper.scenes import TABLE_1_SETS, set_conditions
from paper.tables import refuse_tables, write_tables

import colmap_vg
from colmap_vg.datasets.one_dsfm_folder import read_1dsfm
from colmap_vg.options import Method


def main() -> None:
    """Run the pipeline."""
    parser = argparse.ArgumentParser(description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", type=Path, nargs="+", help="1DSfM folders with gt_bundle.out")
    source.add_argument("--topology", type=Path, help="folder of .mat adjacencies to simulate on")
    parser.add_argument("--output_path", type=Path, required=True, help="receives the folder tables")
    parser.add_argument("--sets", nargs="+", default=list(TABLE_1_SETS), help="of the topology; default: Table 1's")
    parser.add_argument("--seeds", type=int, default=5, help="simulations of each set")
    parser.add_argument("--methods", nargs="+", default=list(TABLE_METHODS), choices=get_args(Method))
    parser.add_argument(
        "--real_edges", type=Path, nargs="+", default=[], help="1DSfM folders whose noise is shown among the ratios"
    )
    parser.add_argument("--six_vertex_draws", type=int, default=500, help="of Fig. 4; 0 leaves it and the ratios out")
    parser.add_argument("--quick", action="store_true", help="the smallest set, one simulation, 20 draws: a minute")
    parser.add_argument("--num_threads", type=int, default=1, help="scenes solved at once")
    parser.add_argument("--resume", action="store_true", help="take up scenes that an earlier run finished")
    parser.add_argument("--overwrite", action="store_true", help="replace tables that are there already")
    arguments = parser.parse_args()
    if arguments.seeds < 1 or arguments.num_threads < 1 or arguments.six_vertex_draws < 0:
        parser.error("--seeds and --num_threads must be at least 1, --six_vertex_draws at least 0")
    methods_wanted = tuple(dict.fromkeys(arguments.methods))
    paper_methods = tuple(method for method in methods_wanted if method != DEFAULT_METHOD)
    if not paper_methods:
        parser.error(f"--methods needs one beside {DEFAULT_METHOD}, which the others are compared with")
    if arguments.real_edges and not arguments.six_vertex_draws:
        parser.error("--real_edges are shown among the ratios of noises, which --six_vertex_draws 0 leaves out")
    if arguments.quick:
        arguments.seeds, arguments.six_vertex_draws = 1, min(20, arguments.six_vertex_draws)
    try:
        refuse_tables(arguments.output_path, arguments.overwrite)
        if arguments.data:
            jobs = [SceneJob(folder.name, str(folder), None, methods_wanted) for folder in arguments.data]
        else:
            for name in arguments.sets:
                set_conditions(arguments.topology, name)  # says of an unknown set before any work is done
            if arguments.quick:
                sizes = {name: (arguments.topology / f"{name}.mat").stat().st_size for name in arguments.sets}
                arguments.sets = [min(sizes, key=lambda name: (sizes[name], name))]
            jobs = [
                SceneJob(name, str(arguments.topology), seed, methods_wanted)
                for name in arguments.sets
                for seed in range(arguments.seeds)
            ]
        real_edges = [edge_noise(folder.resolve().name, read_1dsfm(folder)) for folder in arguments.real_edges]
        work = arguments.output_path / ".work"
        work.mkdir(parents=True, exist_ok=True)
        reports = {}
        for job, report in measured(jobs, work, arguments.resume, arguments.num_threads):
            reports[job] = report
            medians = ", ".join(f"{row.method} {row.median:.3g}" for row in report.rows)
            print(f"{job.dataset} {'' if job.seed is None else job.seed}: median errors {medians}", flush=True)
        folder = write_tables(
            arguments.output_path,
            [reports[job] for job in jobs],
            six_vertex_methods=paper_methods if arguments.six_vertex_draws else (),
            num_draws=arguments.six_vertex_draws,
            num_ratio_seeds=1 if arguments.quick else NUM_RATIO_SEEDS,
            real_edges=real_edges,
            overwrite=arguments.overwrite,
        )
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: {error.strerror}: {error.filename}")
    print(folder / "tables.md")


def measured(
    jobs: list[SceneJob], work: Path, resume: bool, num_threads: int
) -> Iterator[tuple[SceneJob, SceneReport]]:
    """Jobs with their reports, as they finish."""
    if num_threads == 1:
        for job in jobs:
            yield job, measure_or_load(job, work, resume)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # for the processes to come: one scene each, one thread each
    with ProcessPoolExecutor(num_threads, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(measure_or_load, job, work, resume): job for job in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


if __name__ == "__main__":
    main()
