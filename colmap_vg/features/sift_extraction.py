"""Put OpenCV's SIFT features of photographs into a database, on all cores."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.errors import ImageFolderError
from colmap_vg.events import StageLog
from colmap_vg.features.sift import Features, sift_features
from colmap_vg.linear.threads import num_workers
from colmap_vg.options import FeatureOptions

DEFAULT_MAX_IMAGE_SIZE = 3200
"""Pixels; longer side to which larger images are scaled down, as in COLMAP."""
_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
_WAITING_PER_THREAD = 2
"""Images per thread whose features are found or waited for at a time, which bounds the memory."""


def extract_sift(
    image_path: str | PathLike[str],
    database_path: str | PathLike[str],
    names: Sequence[str],
    options: FeatureOptions,
    log: StageLog,
) -> None:
    """Find and write the features of the named images that have none in the database yet.

    Parameters
    ----------
    image_path : path
    database_path : path
        Holds the images already.
    names : sequence of str
    options : FeatureOptions
    log : StageLog

    Raises
    ------
    ImageFolderError
        An image can no longer be read.
    """
    workers = num_workers(options.num_threads)
    with (
        pycolmap.Database.open(database_path) as database,
        _one_thread_per_image(),
        ThreadPoolExecutor(workers) as pool,
    ):
        ids = {image.name: image.image_id for image in database.read_all_images()}
        todo = [name for name in names if not _has_features(database, ids[name])]
        before = len(names) - len(todo)
        log.progress(f"{before} of {len(names)} photographs", before / len(names), before)
        waiting: list[tuple[int, Future[Features]]] = []
        for count, name in enumerate(todo):
            waiting.append((ids[name], pool.submit(image_features, Path(image_path), name, options)))
            if len(waiting) >= _WAITING_PER_THREAD * workers:
                _write(database, *waiting.pop(0))
                done = before + count + 1 - len(waiting)
                log.progress(f"{done} of {len(names)} photographs", done / len(names), done)
        for image_id, features in waiting:
            _write(database, image_id, features)


def image_features(image_path: Path, name: str, options: FeatureOptions) -> Features:
    """Features of an image file, in pixels of the image as it is stored.

    Raises
    ------
    ImageFolderError
        The image or its mask cannot be read.
    """
    limit = options.max_image_size if options.max_image_size > 0 else DEFAULT_MAX_IMAGE_SIZE
    mask = None if options.mask_path is None else _mask(Path(options.mask_path), name)
    return sift_features(_grey(image_path / name), options.max_num_features, limit, mask)


def _grey(path: Path) -> NDArray[np.uint8]:
    grey = cv2.imread(str(path), _GREY)
    if grey is None:  # a format that COLMAP reads and OpenCV does not
        bitmap = pycolmap.Bitmap.read(path, False)
        grey = None if bitmap is None else np.asarray(bitmap.to_array())
    if grey is None:
        raise ImageFolderError(f"{path} can no longer be read")
    return np.asarray(grey, dtype=np.uint8)


def _mask(masks: Path, name: str) -> NDArray[np.uint8]:
    """The mask of an image, where COLMAP looks for it."""
    for path in (masks / f"{name}.png", (masks / name).with_suffix(".png")):
        mask = cv2.imread(str(path), _GREY) if path.is_file() else None
        if mask is not None:
            return np.asarray(mask, dtype=np.uint8)
    raise ImageFolderError(f"the mask of {name} in {masks} can no longer be read")


def _has_features(database: pycolmap.Database, image_id: int) -> bool:
    return bool(database.exists_keypoints(image_id) and database.exists_descriptors(image_id))


def _write(database: pycolmap.Database, image_id: int, features: "Future[Features]") -> None:
    found = features.result()
    if not database.exists_keypoints(image_id):
        database.write_keypoints(image_id, found.keypoints)
    database.write_descriptors(
        image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, found.descriptors)
    )


@contextmanager
def _one_thread_per_image() -> Iterator[None]:
    """Keep OpenCV from threads of its own: images in parallel need none, and together they would be too many."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
