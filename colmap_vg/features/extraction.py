"""Features of a folder of photographs, into a COLMAP database.

pycolmap reads the EXIF orientation itself: features are found on the upright image, and written in the pixels of the
image as it is stored, with the camera of the stored size. So photographs of one phone share their camera's geometry
however it was held, and nothing has to be rotated here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.errors import ImageFolderError, OptionError
from colmap_vg.events import StageLog
from colmap_vg.features.masks import with_masks
from colmap_vg.features.photographs import (
    MIN_IMAGES,
    Photograph,
    SkippedFile,
    find_photographs,
    split_odd_sizes,
)
from colmap_vg.features.sift_extraction import extract_sift
from colmap_vg.linear.threads import num_workers
from colmap_vg.options import FeatureOptions

UNREADABLE = "COLMAP cannot read it"

NAMED_ALONE, LISTED = 2, 5
"""Files skipped for one reason that have a warning each, and names that one warning lists."""

IMAGES_PER_CALL = 8
"""Images per thread and call of pycolmap: progress is told between calls, and a call ends with idle threads."""


@dataclass(frozen=True)
class FeatureResult:
    """What was put into a database.

    Attributes
    ----------
    image_names : tuple of str
        Images of the database, by name.
    skipped : tuple of SkippedFile
        Files that are left out, each with the reason.
    num_verified_pairs : int
    """

    image_names: tuple[str, ...]
    skipped: tuple[SkippedFile, ...]
    num_verified_pairs: int


def check_photographs(
    image_path: str | PathLike[str], options: FeatureOptions, log: StageLog, exclude: Iterable[Path] = ()
) -> tuple[list[Photograph], list[SkippedFile]]:
    """The photographs that can be used, and the files that cannot; warnings say which and why.

    Parameters
    ----------
    image_path : path
    options : FeatureOptions
    log : StageLog
    exclude : iterable of Path
        Folders that are not searched, beside that of the masks.

    Raises
    ------
    ImageFolderError
        Fewer than three photographs can be used.
    OptionError
        The camera model is unknown, or does not take so many parameters.
    """
    _reader_options(options)
    with log.stage("photographs"):
        photographs, skipped = _usable_photographs(image_path, options, log, tuple(exclude))
        log.result(f"{len(photographs)} photographs" + (f", {len(skipped)} files skipped" if skipped else ""))
    return photographs, skipped


def _usable_photographs(
    image_path: str | PathLike[str], options: FeatureOptions, log: StageLog, exclude: tuple[Path, ...]
) -> tuple[list[Photograph], list[SkippedFile]]:
    listed = None if options.image_list_path is None else read_image_list(options.image_list_path)
    masks = None if options.mask_path is None else Path(options.mask_path)
    if masks is not None and masks.resolve() != Path(image_path).resolve():
        exclude += (masks,)
    photographs, skipped = find_photographs(image_path, listed, exclude)
    photographs, odd = split_odd_sizes(photographs, options.camera_mode, bool(options.camera_params))
    skipped += odd
    if masks is not None:
        photographs, spoilt = with_masks(photographs, image_path, masks)
        skipped += spoilt
    _warn_of_skipped(skipped, log)
    whole = [photograph.name for photograph in photographs if masks is not None and photograph.mask is None]
    if whole:
        log.warn(f"{len(whole)} photographs have no mask in {masks}, and are used whole: {_listed(whole)}")
    _require_enough(len(photographs), image_path, skipped)
    return photographs, skipped


def _warn_of_skipped(skipped: Sequence[SkippedFile], log: StageLog) -> None:
    """Warn of each file, or once of many that are skipped for one reason."""
    names_by_reason: dict[str, list[str]] = {}
    for file in skipped:
        names_by_reason.setdefault(file.reason, []).append(file.name)
    for reason, names in names_by_reason.items():
        if len(names) > NAMED_ALONE:
            log.warn(f"skipped {len(names)} files ({_listed(names)}): {reason.replace('it ', 'each ', 1)}")
        else:
            for name in names:
                log.warn(f"skipped {name}: {reason}")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")


def read_image_list(path: str | PathLike[str]) -> list[str]:
    """Names from a file with one image name a line; empty lines and ``#`` comments do not count.

    Raises
    ------
    ImageFolderError
        The file is missing, is no text, or names nothing.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImageFolderError(f"cannot read the image list {path}: {error}; check image_list_path") from error
    names = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not names:
        raise ImageFolderError(f"the image list {path} names no image")
    return names


def _require_enough(num_images: int, image_path: str | PathLike[str], skipped: Sequence[SkippedFile]) -> None:
    if num_images >= MIN_IMAGES:
        return
    found = f"{num_images} photograph{'' if num_images == 1 else 's'}" if num_images else "no photograph"
    reasons = ""
    if skipped:
        reasons = f" ({len(skipped)} files were skipped, the first is {skipped[0].name}: {skipped[0].reason})"
    raise ImageFolderError(f"{image_path} holds {found} that can be used; a model needs at least {MIN_IMAGES}{reasons}")


def _reader_options(options: FeatureOptions) -> pycolmap.ImageReaderOptions:
    models = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    if options.camera_model not in models:
        raise OptionError(f"unknown camera model {options.camera_model!r}; choose one of {', '.join(sorted(models))}")
    reader_options = pycolmap.ImageReaderOptions()
    reader_options.camera_model = options.camera_model
    if options.camera_params:
        example = pycolmap.Camera.create_from_model_name(1, options.camera_model, 1.0, 1, 1)
        if len(options.camera_params) != len(example.params):
            raise OptionError(
                f"{options.camera_model} takes {len(example.params)} camera parameters ({example.params_info}), "
                f"found {len(options.camera_params)}"
            )
        if not np.all(np.isfinite(options.camera_params)):
            raise OptionError(f"camera parameters must be finite numbers, found {options.camera_params}")
        reader_options.camera_params = ",".join(repr(float(value)) for value in options.camera_params)
    if options.mask_path is not None:
        reader_options.mask_path = options.mask_path
    return reader_options


def extract_features(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
) -> tuple[list[str], list[SkippedFile]]:
    """Put cameras, images and SIFT features of the named photographs into a database.

    Returns
    -------
    names : list of str
        Those that COLMAP could read.
    skipped : list of SkippedFile
        The others.

    Raises
    ------
    ImageFolderError
        COLMAP could read fewer than three of them.
    """
    with log.stage("features"):
        readable, unreadable = _import_images(image_path, database_path, names, options, log)
        _extract(image_path, database_path, readable, options, log)
    return readable, unreadable


def _import_images(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
) -> tuple[list[str], list[SkippedFile]]:
    """Number images and cameras by name, in one thread: extraction alone numbers them as its threads end."""
    known = _image_names(database_path)
    new = [name for name in names if name not in known]
    if new:
        log.progress("reading the photographs")
        pycolmap.import_images(database_path, image_path, _camera_mode(options), new, _reader_options(options))
        known = _image_names(database_path)
    unreadable = [SkippedFile(name, UNREADABLE) for name in names if name not in known]
    for file in unreadable:
        log.warn(f"skipped {file.name}: {file.reason}")
    readable = [name for name in names if name in known]
    _require_enough(len(readable), image_path, unreadable)
    return readable, unreadable


def _extract(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
) -> None:
    extract = extract_sift if options.features == "opencv" else _extract_by_colmap
    extract(image_path, database_path, names, options, log)
    with pycolmap.Database.open(database_path) as database:
        counts = {image.name: database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()}
    blank = [name for name in names if counts[name] == 0]
    if blank:
        log.warn(f"no features were found in {', '.join(blank)}: they cannot be matched")
    log.result(f"{sum(counts[name] for name in names)} features in {len(names)} photographs")


def _extract_by_colmap(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
) -> None:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = options.num_threads
    extraction.max_image_size = options.max_image_size
    extraction.sift.max_num_features = options.max_num_features
    camera_mode, reader_options = _camera_mode(options), _reader_options(options)
    step = IMAGES_PER_CALL * num_workers(options.num_threads)
    for start in range(0, len(names), step):
        log.progress(f"{start} of {len(names)} photographs", start / len(names), start)
        part = names[start : start + step]
        pycolmap.extract_features(
            database_path, image_path, part, camera_mode, reader_options, extraction, pycolmap.Device.cpu
        )


def _camera_mode(options: FeatureOptions) -> pycolmap.CameraMode:
    return pycolmap.CameraMode.__members__[options.camera_mode.upper()]


def _image_names(database_path: str | PathLike[str]) -> set[str]:
    with pycolmap.Database.open(database_path) as database:
        return {image.name for image in database.read_all_images()}
