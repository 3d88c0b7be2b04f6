"""hloc's features and matches to a model: takes the place of ``hloc.reconstruction``.

``import hloc_mapper as reconstruction`` replaces ``from hloc import reconstruction`` with this folder on PYTHONPATH;
``python pipelines/hloc_mapper.py`` has hloc's flags. It reads the HDF5 files that hloc's feature extraction and
matching write, makes a COLMAP database, verifies the matches through pycolmap, and maps them. It needs h5py.
"""

import argparse
import ast
import shutil
import sys
import tempfile
import zlib  # noqa: F401  -- before pycolmap, whose bundled copy otherwise breaks the process's own
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from drop_in.stage_lines import show_stages, show_warnings

import colmap_vg
from colmap_vg.errors import DataFileError, ImageFolderError, OptionError, OutputError

COLMAP_FROM_HLOC_PX = 0.5
"""hloc has the middle of the first pixel at 0, COLMAP at 0.5."""
MAX_NUM_TRIALS, MIN_INLIER_RATIO = 20_000, 0.1
"""Options of geometric verification as hloc sets them: learned matchers find pairs with few inliers."""
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin")

StrPath = str | PathLike[str]


def main(
    sfm_dir: StrPath,
    image_dir: StrPath,
    pairs: StrPath,
    features: StrPath,
    matches: StrPath,
    camera_mode: pycolmap.CameraMode = pycolmap.CameraMode.AUTO,
    verbose: bool = False,
    skip_geometric_verification: bool = False,
    min_match_score: float | None = None,
    image_list: Sequence[str] | None = None,
    image_options: Mapping[str, Any] | None = None,
    mapper_options: Mapping[str, Any] | colmap_vg.MappingOptions | None = None,
) -> pycolmap.Reconstruction:
    """Make a model from hloc's features and matches, with the arguments of hloc's function of this name.

    Parameters
    ----------
    sfm_dir : path
        Receives ``database.db``, the files of the largest model, and the other models in ``models``. Those of an
        earlier job are replaced when this one succeeds.
    image_dir : path
        Folder of the photographs.
    pairs : path
        Text file with two image names per line.
    features, matches : path
        HDF5 files: keypoints of each image, in pixels with the middle of the first pixel at 0; for each pair and
        keypoint of its first image the index of the matched keypoint, or -1, and the score of the match.
    camera_mode : pycolmap.CameraMode
    verbose : bool
        Print each stage.
    skip_geometric_verification : bool
        Take the matches as they are.
    min_match_score : float, optional
        Matches with this score or a lower one are left out.
    image_list : sequence of str, optional
        Names of the photographs to use; all by default.
    image_options : mapping, optional
        Options of `pycolmap.ImageReaderOptions`, such as ``camera_model``.
    mapper_options : mapping or MappingOptions, optional
        Of a mapping, entries with the name of a field of `MappingOptions`, and ``min_num_matches``, are obeyed; others
        are named in a warning.

    Returns
    -------
    pycolmap.Reconstruction
        The largest model.

    Raises
    ------
    ColmapVgError
        h5py is missing, files are missing or contradict each other, or no model could be made. `sfm_dir` is as it was.
    """
    sfm, photographs = Path(sfm_dir), Path(image_dir)
    options, ignored = mapping_options(mapper_options)
    for name in ignored:
        print(f"warning: the mapper option {name} has no counterpart in colmap-vg and is ignored", file=sys.stderr)
    for path in (Path(pairs), Path(features), Path(matches)):
        if not path.is_file():
            raise DataFileError(f"{path} does not exist or is not a file: run hloc's step that writes it")
    with _work_folder(sfm) as work:
        database_path = work / "database.db"
        _import_images(database_path, photographs, camera_mode, image_list or [], dict(image_options or {}))
        names = _import_features(database_path, Path(features))
        imported = _import_matches(
            database_path, names, read_pairs(Path(pairs)), Path(matches), min_match_score, skip_geometric_verification
        )
        if not skip_geometric_verification:
            _verify(database_path, work / "pairs.txt", imported, options.random_seed)
        found = colmap_vg.view_graph_mapping(
            database_path, photographs, work / "models", options, on_event=show_stages if verbose else show_warnings
        )
        _publish(work, sfm, len(found))
    return found[0]


def mapping_options(
    given: Mapping[str, Any] | colmap_vg.MappingOptions | None,
) -> tuple[colmap_vg.MappingOptions, list[str]]:
    """Options of the mapping job, and names of COLMAP's options that have no counterpart."""
    if isinstance(given, colmap_vg.MappingOptions):
        return given, []
    known = {field.name for field in fields(colmap_vg.MappingOptions)}
    values = dict(given or {})
    read = {"min_num_inliers": values.pop("min_num_matches")} if "min_num_matches" in values else {}
    obeyed = {name: value for name, value in values.items() if name in known}
    if read and "read" in obeyed:
        raise OptionError("mapper_options: min_num_matches and read contradict each other; give one of them")
    if read:
        obeyed["read"] = colmap_vg.ReadOptions(**read)
    return colmap_vg.MappingOptions(**obeyed), sorted(set(values) - known)


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Pairs of image names, each pair once, whichever image comes first.

    Raises
    ------
    DataFileError
        A line does not hold two different names.
    """
    pairs: dict[frozenset[str], tuple[str, str]] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        if len(words) != 2 or words[0] == words[1]:
            raise DataFileError(f"{path}, line {number}: expected the names of two images, found {line!r}")
        pairs.setdefault(frozenset(words), (words[0], words[1]))
    return list(pairs.values())


def pair_group(name1: str, name2: str, separator: str = "/") -> str:
    """Name of a pair's group in the file of matches; ``_`` is the separator of hloc's first versions."""
    return separator.join(name.replace("/", "-") for name in (name1, name2))


@contextmanager
def _work_folder(sfm: Path) -> Iterator[Path]:
    """A folder beside the results that is removed in any case; an output folder that was made for it, too, if empty."""
    made = [path for path in (sfm, *sfm.parents) if not path.exists()]
    try:
        sfm.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".mapping-", dir=sfm))
    except OSError as error:
        raise OutputError(f"cannot write to {sfm}: {error.strerror}; choose another sfm_dir") from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        for path in made:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _import_images(
    database_path: Path,
    image_dir: Path,
    camera_mode: pycolmap.CameraMode,
    image_list: Sequence[str],
    image_options: dict[str, Any],
) -> None:
    if not image_dir.is_dir() or not any(image_dir.iterdir()):
        raise ImageFolderError(f"{image_dir} does not exist or is empty: choose the folder of the photographs")
    try:
        reading = pycolmap.ImageReaderOptions(image_options)
    except (TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"image_options {image_options} are not those of pycolmap.ImageReaderOptions") from error
    pycolmap.Database.open(database_path).close()
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    try:
        pycolmap.import_images(database_path, image_dir, camera_mode, image_names=list(image_list), options=reading)
    except (ValueError, RuntimeError) as error:
        raise ImageFolderError(f"pycolmap cannot read {image_dir} with these image_options: {error}") from error
    finally:
        pycolmap.logging.minloglevel = level


def _import_features(database_path: Path, path: Path) -> dict[str, tuple[int, int]]:
    """Store the keypoints of all images; return for each name the id and the number of keypoints."""
    names: dict[str, tuple[int, int]] = {}
    with _opened(path) as file, pycolmap.Database.open(database_path) as database:
        images = database.read_all_images()
        if not images:
            raise ImageFolderError("pycolmap could read none of the photographs: check image_dir and image_list")
        for image in images:
            if f"{image.name}/keypoints" not in file:
                raise DataFileError(
                    f"{path} has no keypoints of {image.name}: extract its features, or leave it out by image_list"
                )
            keypoints = np.asarray(file[f"{image.name}/keypoints"], dtype=np.float64)
            if keypoints.ndim != 2 or keypoints.shape[1] < 2 or not np.isfinite(keypoints[:, :2]).all():
                raise DataFileError(f"{path}: the keypoints of {image.name} are no finite positions, (n, 2)")
            shifted = (keypoints[:, :2] + COLMAP_FROM_HLOC_PX).astype(np.float32)
            database.write_keypoints(image.image_id, shifted)
            names[image.name] = (image.image_id, len(keypoints))
    return names


def _import_matches(
    database_path: Path,
    names: Mapping[str, tuple[int, int]],
    pairs: Sequence[tuple[str, str]],
    path: Path,
    min_match_score: float | None,
    as_verified: bool,
) -> list[tuple[str, str]]:
    """Store the matches of the pairs; return the pairs."""
    if not pairs:
        raise DataFileError("the list of pairs is empty: match at least two pairs of three images")
    with _opened(path) as file, pycolmap.Database.open(database_path) as database:
        for pair in pairs:
            for name in pair:
                if name not in names:
                    raise DataFileError(f"the list of pairs names {name}, which is not among the photographs")
            (image_id1, _), (image_id2, _) = ids = names[pair[0]], names[pair[1]]
            matches = _matches(file, path, pair, min_match_score)
            if len(matches) and (matches.max(axis=0) >= [count for _, count in ids]).any():
                raise DataFileError(
                    f"{path}: a match of {pair[0]} and {pair[1]} names a keypoint that does not exist: match again"
                )
            database.write_matches(image_id1, image_id2, matches)
            if as_verified:
                geometry = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches
                )
                database.write_two_view_geometry(image_id1, image_id2, geometry)
    return list(pairs)


def _matches(file: Any, path: Path, pair: tuple[str, str], min_match_score: float | None) -> np.ndarray:
    """Keypoint indices (k, 2) uint32 of a pair's matches, from its group or that of the reversed pair."""
    candidates = [(pair_group(*names, sep), names != pair) for sep in "/_" for names in (pair, pair[::-1])]
    found = next(((group, swapped) for group, swapped in candidates if f"{group}/matches0" in file), None)
    if found is None:
        raise DataFileError(f"{path} has no matches of {pair[0]} and {pair[1]}: match this list of pairs")
    group, swapped = found
    of_first = np.asarray(file[f"{group}/matches0"]).astype(np.int64).ravel()
    kept = of_first >= 0
    if min_match_score is not None:
        if f"{group}/matching_scores0" not in file:
            raise DataFileError(f"{path}: {group} has no scores: leave min_match_score out")
        kept &= np.asarray(file[f"{group}/matching_scores0"], dtype=np.float64).ravel() > min_match_score
    rows = np.flatnonzero(kept)
    matches = np.stack([rows, of_first[rows]], axis=1).astype(np.uint32)
    return matches[:, ::-1].copy() if swapped else matches


def _verify(database_path: Path, pairs_path: Path, pairs: Sequence[tuple[str, str]], seed: int) -> None:
    pairs_path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_num_trials = MAX_NUM_TRIALS
    options.ransac.min_inlier_ratio = MIN_INLIER_RATIO
    options.ransac.random_seed = seed
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    try:
        pycolmap.verify_matches(database_path, pairs_path, options)
    finally:
        pycolmap.logging.minloglevel = level


def _publish(work: Path, sfm: Path, num_models: int) -> None:
    """Move the database, the largest model's files and the other models to where hloc has them."""
    old, models = work / "replaced", sfm / "models"
    try:
        old.mkdir()
        if models.is_dir():
            for path in models.iterdir():
                if path.is_dir() and path.name.isdecimal():
                    path.rename(old / path.name)
        for index in range(1, num_models):
            models.mkdir(exist_ok=True)
            (work / "models" / str(index)).rename(models / str(index))
        for name in MODEL_FILES:
            (work / "models" / "0" / name).replace(sfm / name)
        (work / "database.db").replace(sfm / "database.db")
    except OSError as error:
        raise OutputError(f"cannot move the model to {sfm}: {error.strerror} ({error.filename})") from error


def _opened(path: Path) -> Any:
    """An HDF5 file, open for reading."""
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise colmap_vg.ColmapVgError(
            "hloc's files are HDF5, and h5py is missing: pip install h5py, or colmap_vg with its extra hloc"
        ) from error
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise DataFileError(f"{path} is not an HDF5 file, or is damaged: {error}") from error


def _entries(words: Sequence[str]) -> dict[str, Any]:
    """The entries of ``key=value`` words, with values that are Python literals, or else text."""
    entries: dict[str, Any] = {}
    for word in words:
        name, separator, value = word.partition("=")
        if not separator:
            raise OptionError(f"expected key=value, found {word!r}")
        try:
            literal = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            literal = value
        entries[name] = value if isinstance(literal, tuple) else literal  # camera_params is text: 1280,512,384
    return entries


def command_line() -> None:
    """Run with hloc's flags."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sfm_dir", type=Path, required=True, help="receives the database and the model")
    parser.add_argument("--image_dir", type=Path, required=True, help="folder of the photographs")
    parser.add_argument("--pairs", type=Path, required=True, help="text file with two image names per line")
    parser.add_argument("--features", type=Path, required=True, help="HDF5 file of hloc's features")
    parser.add_argument("--matches", type=Path, required=True, help="HDF5 file of hloc's matches")
    parser.add_argument("--camera_mode", default="AUTO", choices=list(pycolmap.CameraMode.__members__))
    parser.add_argument("--skip_geometric_verification", action="store_true", help="take the matches as they are")
    parser.add_argument("--min_match_score", type=float, help="leave out matches with this score or a lower one")
    parser.add_argument("--verbose", action="store_true", help="print each stage")
    parser.add_argument("--image_options", nargs="+", default=[], metavar="KEY=VALUE", help="of ImageReaderOptions")
    parser.add_argument("--mapper_options", nargs="+", default=[], metavar="KEY=VALUE", help="of MappingOptions")
    given = vars(parser.parse_args())
    given["camera_mode"] = pycolmap.CameraMode.__members__[given["camera_mode"]]
    try:
        given |= {name: _entries(given[name]) for name in ("image_options", "mapper_options")}
        model = main(**given)
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
    print(f"{given['sfm_dir']}: {model.summary()}")


if __name__ == "__main__":
    command_line()
