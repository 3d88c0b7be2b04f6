"""From a folder of photographs to models, from a checkout: ``python pipelines/image_folder.py IMAGES OUTPUT``."""

import argparse
import sys
from pathlib import Path
from typing import get_args

import colmap_vg
from colmap_vg.events import StageEvent
from colmap_vg.options import Matching


def show(event: StageEvent) -> None:
    """Print what is worth a line."""
    if event.state in ("finished", "warning"):
        print(f"{event.stage}: {event.message} ({event.seconds:.1f} s)", flush=True)


def main() -> None:
    """Run the pipeline."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("image_path", type=Path, help="folder of photographs")
    parser.add_argument("output_path", type=Path, help="receives database.db and the models 0, 1, ...")
    parser.add_argument("--camera_mode", default="auto", choices=["auto", "single", "per_folder", "per_image"])
    parser.add_argument("--matching", default="auto", choices=get_args(Matching))
    parser.add_argument("--overwrite", action="store_true", help="replace models that are there already")
    arguments = parser.parse_args()
    features = colmap_vg.FeatureOptions(camera_mode=arguments.camera_mode, matching=arguments.matching)
    options = colmap_vg.MappingOptions(overwrite=arguments.overwrite)
    try:
        models = colmap_vg.image_folder_mapping(
            arguments.image_path, arguments.output_path, features, options, on_event=show
        )
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    for index, model in models.items():
        print(f"{arguments.output_path / str(index)}: {model.summary()}")


if __name__ == "__main__":
    main()
