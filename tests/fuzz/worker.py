"""Runs many cases in one process and tells of each before and after: ``python worker.py KIND FIRST LAST FOLDER``.

A line ``begin SEED`` comes before a case and ``end SEED OUTCOME`` after it, so that whoever reads knows the case that
took the process along.
"""

import hashlib
import shutil
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "scenes"))

import numpy as np
import pycolmap
from damaged_databases import damaged, sound_databases
from odd_graphs import odd_case

from colmap_vg.errors import ColmapVgError
from colmap_vg.jobs.mapper import view_graph_mapping
from colmap_vg.options import MappingOptions, SolveOptions
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.solve import solve_view_graph


def database_case(seed: int, sound: list[Path], folder: Path) -> str:
    """Map a damaged database."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "in").mkdir(parents=True)
    path = folder / "in" / "database.db"
    names = damaged(sound, path, seed)
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        models = view_graph_mapping(path, None, folder / "out", MappingOptions(num_threads=1))
    except ColmapVgError as error:
        outcome = f"{type(error).__name__}: {error}"
        if (folder / "out").exists():
            return f"FAULT the output folder stays behind; {names}"
    else:
        outcome = f"{len(models)} models"
        for index, model in models.items():
            if fault := _not_finite(model):
                return f"FAULT {fault}; {names}"
            written = pycolmap.Reconstruction(folder / "out" / str(index))
            if written.num_reg_images() != model.num_reg_images():
                return f"FAULT another model was written; {names}"
    if hashlib.sha256(path.read_bytes()).hexdigest() != before:
        return f"FAULT the database was changed; {names}"
    if [p.name for p in path.parent.iterdir()] != [path.name]:
        return f"FAULT files were left beside the database; {names}"
    return f"{outcome} {names}"


def _not_finite(model: pycolmap.Reconstruction) -> str | None:
    for image_id in model.reg_image_ids():
        pose = model.image(image_id).cam_from_world()
        if not np.isfinite(pose.matrix()).all():
            return f"pose of image {image_id} is not finite"
    for camera_id in {model.image(i).camera_id for i in model.reg_image_ids()}:
        if not np.isfinite(model.camera(camera_id).params).all():
            return f"camera {camera_id} is not finite"
    if not all(np.isfinite(point.xyz).all() for point in model.points3D.values()):
        return "a point is not finite"
    return None


def graph_case(seed: int) -> str:
    """Solve an odd graph."""
    fields, options, odd = odd_case(seed)
    fields.pop("_true", None)
    try:
        solution = solve_view_graph(ViewGraph(**fields), SolveOptions(**options))
    except ColmapVgError as error:
        return f"{type(error).__name__}: {error}"
    placed = solution.component >= 0
    poses = (solution.cam_from_world_rotations[placed], solution.projection_centers[placed])
    if not all(np.isfinite(value).all() for value in poses):
        return f"FAULT a pose is not finite; {odd} {options['method']}"
    R = poses[0]
    if len(R) and np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() > 1e-9:
        return f"FAULT a rotation is none; {odd} {options['method']}"
    if not np.isfinite(solution.focal_scales).all() or (solution.focal_scales <= 0).any():
        return f"FAULT a focal length is not positive; {odd} {options['method']}"
    return f"{solution.status} {int(placed.sum())} of {len(placed)} {odd}"


def main() -> None:
    kind, first, last, folder = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    folder.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    warnings.simplefilter("ignore")
    sound = [folder / name for name in ("one.db", "own.db", "posed.db")]
    if kind == "database" and not all(path.exists() for path in sound):
        sound_databases(folder)
    for seed in range(first, last):
        print(f"begin {seed}", flush=True)
        try:
            outcome = database_case(seed, sound, folder / "case") if kind == "database" else graph_case(seed)
        except Exception as error:  # noqa: BLE001  -- what is looked for
            import traceback

            frames = traceback.extract_tb(error.__traceback__)[-5:]
            places = " < ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in reversed(frames))
            outcome = f"FAULT {type(error).__name__}: {error} at {places}"
        print(f"end {seed} {' '.join(outcome.split())}", flush=True)


if __name__ == "__main__":
    main()
