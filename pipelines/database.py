"""From a COLMAP database to models, from a checkout: ``python pipelines/database.py DATABASE OUTPUT``."""

import argparse
import sys
from pathlib import Path

import colmap_vg
from colmap_vg.events import StageEvent


def show(event: StageEvent) -> None:
    """Print what is worth a line."""
    if event.state in ("finished", "warning"):
        print(f"{event.stage}: {event.message} ({event.seconds:.1f} s)", flush=True)


def main() -> None:
    """Run the pipeline."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("database_path", type=Path, help="COLMAP database; it is not modified")
    parser.add_argument("output_path", type=Path, help="receives the models 0, 1, ...")
    parser.add_argument("--images", type=Path, help="folder of the photographs, for the colours of points")
    parser.add_argument("--method", default="epipolar", help="how positions are solved")
    parser.add_argument("--overwrite", action="store_true", help="replace models that are there already")
    arguments = parser.parse_args()
    try:
        options = colmap_vg.MappingOptions(
            solve=colmap_vg.SolveOptions(method=arguments.method), overwrite=arguments.overwrite
        )
        models = colmap_vg.view_graph_mapping(
            arguments.database_path, arguments.images, arguments.output_path, options, on_event=show
        )
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    for index, model in models.items():
        print(f"{arguments.output_path / str(index)}: {model.summary()}")


if __name__ == "__main__":
    main()
