"""``colmap-vg-colmap``: COLMAP's command line with its mappers replaced by ``colmap-vg mapper``.

Scripts that call COLMAP or GLOMAP run with this program in its place: the mappers take the same flags, and every other
command is handed to the real program on PATH.
"""

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from colmap_vg._version import __version__

MAPPERS = ("mapper", "global_mapper", "hierarchical_mapper", "pose_prior_mapper")
"""Commands that ``colmap-vg mapper`` takes the place of."""
NAME = "colmap-vg-colmap"
TRIED = "COLMAP_VG_COLMAP_TRIED"
"""Environment variable with the programs that commands were handed to, so that one that calls this one is not called
again."""
USAGE = f"""{NAME} {__version__}: COLMAP's command line, with the mappers of colmap-vg.

  {NAME} mapper --database_path DB --image_path IMAGES --output_path OUT
  {NAME} COMMAND ...

{", ".join(MAPPERS)}: run colmap-vg mapper, with the same flags.
All other commands are handed to the colmap on PATH."""

_INSTEAD = {
    "automatic_reconstructor": "`colmap-vg run` for the sparse model",
    "feature_extractor": "`colmap-vg run`, or pycolmap.extract_features",
    "exhaustive_matcher": "`colmap-vg run --matching exhaustive`, or pycolmap.match_exhaustive",
    "sequential_matcher": "`colmap-vg run --matching sequential`, or pycolmap.match_sequential",
    "spatial_matcher": "`colmap-vg run --matching spatial`, or pycolmap.match_spatial",
    "vocab_tree_matcher": "`colmap-vg run`, or pycolmap.match_vocabtree",
    "matches_importer": "pycolmap.verify_matches",
    "geometric_verifier": "pycolmap.geometric_verification",
    "image_undistorter": "pycolmap.undistort_images",
    "point_triangulator": "pycolmap.triangulate_points",
    "bundle_adjuster": "pycolmap.bundle_adjustment",
    "model_aligner": "`colmap-vg align`",
    "model_converter": "pycolmap.Reconstruction with write_text, write_binary and export_PLY",
    "model_analyzer": "pycolmap.Reconstruction with summary",
    "rig_configurator": "`colmap-vg run --rig_config_path`",
    "view_graph_calibrator": "`colmap-vg mapper`, which calibrates",
}
"""What does without COLMAP what its commands do."""


def main() -> None:
    """Entry point of ``colmap-vg-colmap``."""
    arguments = sys.argv[1:]
    if arguments and arguments[0] in MAPPERS:
        from colmap_vg.cli.main import main as colmap_vg_main

        sys.argv = ["colmap-vg", "mapper", *arguments[1:]]
        colmap_vg_main()
        return
    name = "glomap" if Path(sys.argv[0]).name == "glomap" else "colmap"
    tried = [path for path in os.environ.get(TRIED, "").split(os.pathsep) if path]
    program = real_program(name, tried)
    if program is not None:
        _hand_over(program, arguments, tried)
    if not arguments or arguments[0] in ("help", "-h", "--help"):
        print(USAGE)
        return
    instead = _INSTEAD.get(arguments[0])
    remedy = f"install COLMAP, or use {instead}" if instead else "install COLMAP"
    _fail(f"{arguments[0]} is a command of {name}, and there is no {name} on PATH: {remedy}")


def real_program(name: str, tried: Sequence[str] = ()) -> str | None:
    """Find the first program of a name on PATH that was not tried yet.

    Parameters
    ----------
    name : str
    tried : sequence of str
        Files that are passed over: they turned out to call this program.

    Returns
    -------
    str or None
    """
    for folder in os.get_exec_path():
        found = shutil.which(name, path=folder)
        if found is not None and found not in tried:
            return found
    return None


def _hand_over(program: str, arguments: Sequence[str], tried: Sequence[str]) -> NoReturn:
    """Go on as another program."""
    sys.stdout.flush()
    os.environ[TRIED] = os.pathsep.join([*tried, program])
    try:
        os.execv(program, [program, *arguments])
    except OSError as error:
        _fail(f"cannot run {program}: {error.strerror}; repair it, or put another one first on PATH")


def _fail(message: str) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(1)
