"""Where a script calls pycolmap.global_mapping, call colmap_vg.view_graph_mapping: the same arguments, the same result.

Usage: python examples/swap_global_mapping.py DATABASE IMAGES OUTPUT
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import colmap_vg  # before pycolmap: it keeps zlib working

# isort: split
import pycolmap

Mapper = Callable[[Path, Path, Path], dict[int, pycolmap.Reconstruction]]


def show(name: str, mapper: Mapper, database: Path, images: Path, output: Path) -> None:
    output.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    models = mapper(database, images, output)
    seconds = time.perf_counter() - start
    for index, model in models.items():
        model.update_point_3d_errors()
        print(
            f"{name} model {index}: {model.num_reg_images()} images, {model.num_points3D()} points, "
            f"{model.compute_mean_reprojection_error():.2f} px, {seconds:.1f} s"
        )


def main(database: Path, images: Path, output: Path) -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    copy = output / "global_mapping.db"  # pycolmap changes every database that it opens
    output.mkdir(parents=True, exist_ok=True)
    copy.write_bytes(database.read_bytes())
    show("global_mapping", pycolmap.global_mapping, copy, images, output / "global_mapping")
    show("view_graph_mapping", colmap_vg.view_graph_mapping, database, images, output / "view_graph_mapping")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*map(Path, sys.argv[1:]))
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
