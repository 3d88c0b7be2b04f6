"""Photographs to nerfstudio's data: takes the place of ``ns-process-data images``.

``python pipelines/nerfstudio_mapper.py images --data PHOTOGRAPHS --output-dir OUT`` has the flags of that command, and
writes what it writes: ``images`` and ``images_2``, ``images_4``, ... with their sizes halved, ``colmap`` with the
database and the model, ``transforms.json`` and ``sparse_pc.ply``. ``OUT`` appears when it is complete.
"""

import argparse
import shutil
import sys
import tempfile
import zlib  # noqa: F401  -- before pycolmap, whose bundled copy otherwise breaks the process's own
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from drop_in.stage_lines import show_stages, show_warnings

import colmap_vg
from colmap_vg.errors import ImageFolderError, OutputError
from colmap_vg.exports.nerfstudio import write_nerfstudio
from colmap_vg.exports.source import find_source
from colmap_vg.options import FeatureOptions, MappingOptions

CAMERA_MODELS = {
    "perspective": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "pinhole": "PINHOLE",
    "simple_pinhole": "SIMPLE_PINHOLE",
}
"""COLMAP's camera models of nerfstudio's camera types."""
MATCHING = {"vocab_tree": "auto", "exhaustive": "exhaustive", "sequential": "sequential"}
"""Values of `FeatureOptions.matching` for nerfstudio's matching methods."""
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})
IGNORED = {
    "sfm-tool": 1,
    "feature-type": 1,
    "matcher-type": 1,
    "colmap-cmd": 1,
    "gpu": 0,
    "no-gpu": 0,
    "refine-pixsfm": 0,
    "no-refine-pixsfm": 0,
    "refine-intrinsics": 0,
    "same-dimensions": 0,
    "no-same-dimensions": 0,
}
"""Flags of nerfstudio without a counterpart, and their numbers of values."""


def main(
    data: Path,
    output_dir: Path,
    *,
    camera_type: str = "perspective",
    matching_method: str = "vocab_tree",
    num_downscales: int = 3,
    use_single_camera_mode: bool = True,
    overwrite: bool = False,
    verbose: bool = False,
) -> pycolmap.Reconstruction:
    """Make nerfstudio's data from a folder of photographs.

    Parameters
    ----------
    data : Path
        Folder of photographs, searched recursively. They are copied as ``frame_00001.jpg``, ... in order of name.
    output_dir : Path
        Must be missing or empty, unless `overwrite`.
    camera_type : str
        A key of `CAMERA_MODELS`.
    matching_method : str
        A key of `MATCHING`; ``vocab_tree`` selects pairs that are likely to overlap.
    num_downscales : int
        Number of times that the sizes of the images are halved.
    use_single_camera_mode : bool
        Whether all photographs were taken with one lens.
    overwrite : bool
        Replace an earlier output.
    verbose : bool
        Print each stage.

    Returns
    -------
    pycolmap.Reconstruction
        The largest model, which ``transforms.json`` describes.

    Raises
    ------
    ColmapVgError
        There are no photographs, no model can be made, or the output exists or cannot be written.
    """
    photographs = sorted(path for path in data.rglob("*") if path.suffix.lower() in SUFFIXES) if data.is_dir() else []
    if not photographs:
        raise ImageFolderError(f"{data}: no photographs are there ({', '.join(sorted(SUFFIXES))}); check --data")
    if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())) and not overwrite:
        raise OutputError(f"{output_dir} is not empty: choose another --output-dir, or replace it with --overwrite")
    output_dir = output_dir.absolute()
    try:
        output_dir.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{output_dir.name}.", dir=output_dir.parent) as made:
            work = Path(made) / "data"
            features = FeatureOptions(
                camera_model=CAMERA_MODELS[camera_type],
                camera_mode="single" if use_single_camera_mode else "auto",
                matching=MATCHING[matching_method],
            )
            found = _make(photographs, work, features, num_downscales, verbose)
            if output_dir.exists():
                output_dir.rename(Path(made) / "replaced")
            work.rename(output_dir)
    except OSError as error:
        raise OutputError(f"cannot write {output_dir}: {error.strerror}; choose another --output-dir") from error
    return found


def _make(
    photographs: list[Path], work: Path, features: FeatureOptions, num_downscales: int, verbose: bool
) -> pycolmap.Reconstruction:
    images, colmap = work / "images", work / "colmap"
    images.mkdir(parents=True)
    for number, path in enumerate(photographs, start=1):
        shutil.copyfile(path, images / f"frame_{number:05d}{path.suffix.lower()}")
    models = colmap_vg.image_folder_mapping(
        images, colmap / "sparse", features, MappingOptions(), show_stages if verbose else show_warnings
    )
    (colmap / "sparse" / "database.db").rename(colmap / "database.db")
    shutil.rmtree(colmap / "sparse" / ".work", ignore_errors=True)
    for note in write_nerfstudio(find_source(colmap / "sparse" / "0", images), work, work):
        print(f"warning: {note}", file=sys.stderr)
    _downscale(images, num_downscales)
    return models[0]


def _downscale(images: Path, num_downscales: int) -> None:
    """Write the images with halved sizes beside their folder, as they are stored, before any EXIF orientation."""
    for path in sorted(images.iterdir()):
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)  # EXIF orientation is ignored, too
        if pixels is None:
            raise ImageFolderError(f"{path.name} cannot be read; convert it to JPEG or PNG")
        for power in range(1, num_downscales + 1):
            folder = images.with_name(f"images_{2**power}")
            folder.mkdir(exist_ok=True)
            height, width = (max(side // 2**power, 1) for side in pixels.shape[:2])
            small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
            written, encoded = cv2.imencode(path.suffix, small)
            if not written:
                raise ImageFolderError(f"{path.name} cannot be written at a smaller size; convert it to JPEG or PNG")
            (folder / path.name).write_bytes(encoded.tobytes())


def command_line() -> None:
    """Run with nerfstudio's flags."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["images"], help="of data: a folder of photographs")
    parser.add_argument("--data", type=Path, required=True, help="folder of photographs")
    parser.add_argument("--output-dir", "--output_dir", type=Path, required=True, help="folder to write")
    parser.add_argument("--camera-type", "--camera_type", default="perspective", choices=list(CAMERA_MODELS))
    parser.add_argument("--matching-method", "--matching_method", default="vocab_tree", choices=list(MATCHING))
    parser.add_argument("--num-downscales", "--num_downscales", type=int, default=3, help="times that sizes are halved")
    parser.add_argument(
        "--use-single-camera-mode", "--use_single_camera_mode", default="True", choices=["True", "False"]
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier output")
    parser.add_argument("--verbose", action="store_true", help="print each stage")
    parser.add_argument("--no-verbose", dest="verbose", action="store_false")
    for flag, count in IGNORED.items():
        names = (f"--{flag}",) if "-" not in flag else (f"--{flag}", f"--{flag.replace('-', '_')}")
        parser.add_argument(*names, nargs=count, action=_Ignored, help=argparse.SUPPRESS)
    given = vars(parser.parse_args())
    given = {name: value for name, value in given.items() if name.replace("_", "-") not in (*IGNORED, "kind")}
    given["use_single_camera_mode"] = given["use_single_camera_mode"] == "True"
    if given["num_downscales"] < 0:
        parser.error("--num-downscales must be 0 or more")
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        model = main(given.pop("data"), given.pop("output_dir"), **given)
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    print(model.summary())


class _Ignored(argparse.Action):
    """A flag of nerfstudio without a counterpart, which is named in a warning."""

    def __call__(self, *given: object) -> None:
        print(f"warning: {given[-1]} has no counterpart in colmap-vg and is ignored", file=sys.stderr)


if __name__ == "__main__":
    command_line()
