"""Databases of photographs, made in one process."""

import os
from os import PathLike
from pathlib import Path

from colmap_vg.events import StageLog
from colmap_vg.features.extraction import FeatureResult, check_photographs, extract_features
from colmap_vg.features.matching import match_features
from colmap_vg.features.rigs import configure_rigs, wants_rigs, with_rig_cameras
from colmap_vg.features.staging import readable_folder
from colmap_vg.options import FeatureOptions


def extract_and_match(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    options: FeatureOptions | None = None,
    log: StageLog | None = None,
) -> FeatureResult:
    """Extract and match the features of a folder of photographs, where neither process nor record is asked for."""
    options, log = with_rig_cameras(FeatureOptions.given(options)), log or StageLog()
    photographs, skipped = check_photographs(image_path, options, log)
    names = [photograph.name for photograph in photographs]
    copies = Path(f"{os.fspath(database_path)}-copies")
    with readable_folder(image_path, photographs, options, copies) as (folder, reading):
        names, unreadable = extract_features(folder, database_path, names, reading, log)
    if wants_rigs(options):
        configure_rigs(database_path, options)
    num_pairs = match_features(database_path, options, log)
    return FeatureResult(tuple(names), (*skipped, *unreadable), num_pairs)
