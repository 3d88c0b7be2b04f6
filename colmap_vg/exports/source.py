"""Find the model to export, and the folder of its photographs, from the folder of a model or of a finished job."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError, ImageFolderError, OptionError
from colmap_vg.jobs.output_folder import existing_models
from colmap_vg.jobs.summary import FILE_NAME as SUMMARY_NAME
from colmap_vg.jobs.summary import given_path, read_summary

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Source:
    """A model to export.

    Attributes
    ----------
    folder : Path
        Of the model.
    reconstruction : pycolmap.Reconstruction
    image_path : Path or None
        Folder of the photographs, if it is known.
    job : Path or None
        Folder of the finished job that made the model, if it was given.
    """

    folder: Path
    reconstruction: "pycolmap.Reconstruction"
    image_path: Path | None = None
    job: Path | None = None

    def images(self) -> list["pycolmap.Image"]:
        """Return the images that have a pose, by name."""
        model = self.reconstruction
        return sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)

    def photographs(self) -> Path:
        """Return the folder of the photographs.

        Raises
        ------
        ImageFolderError
            It is not known, or is no folder.
        """
        if self.image_path is None:
            raise ImageFolderError("this format needs the photographs: give their folder as image_path")
        if not self.image_path.is_dir():
            raise ImageFolderError(f"no such image folder: {self.image_path}; check image_path")
        return self.image_path


def find_source(input_path: Path, image_path: Path | None = None, model: int | None = None) -> Source:
    """Read the model to export.

    Parameters
    ----------
    input_path : Path
        Folder of a COLMAP model, or of a finished job with models ``0``, ``1``, ...
    image_path : Path, optional
        Folder of the photographs. Default: that of the job.
    model : int, optional
        Which model of a job; default: 0.

    Raises
    ------
    DataFileError
        There is no model, it cannot be read, or none of its images has a pose.
    OptionError
        `model` is given for the folder of a model, or the job has no such model.
    """
    models = existing_models(input_path)
    is_model = input_path in models
    if is_model and model is not None:
        raise OptionError(f"{input_path} is the folder of one model: leave out model, or give the folder of a job")
    numbered = {path.name: path for path in models if path != input_path}
    folder = input_path if is_model else numbered.get(str(model or 0))
    if folder is None and model is not None and numbered:
        raise OptionError(f"{input_path} has no model {model}; it has {', '.join(numbered)}")
    if folder is None:
        raise DataFileError(f"{input_path}: no COLMAP model, and no finished job with a model, is there")
    job = None if is_model else input_path
    if job is not None and image_path is None and (job / SUMMARY_NAME).exists():
        image_path = given_path(read_summary(job), "image_path", job / "images")
    source = Source(folder, _read(folder), image_path, job)
    if not source.images():
        raise DataFileError(f"{folder}: no image of the model has a pose")
    return source


def _read(folder: Path) -> "pycolmap.Reconstruction":
    try:
        model = pycolmap.Reconstruction(folder)
        for image in model.images.values():
            image.name  # noqa: B018  -- raises where it is not UTF-8
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        raise DataFileError(f"{folder}: is no COLMAP model that can be read ({error})") from error
    return model


def world_from_cam(image: "pycolmap.Image") -> tuple[Array, Array]:
    """Return an image's quaternion (4,), x y z w, from camera to world, and its projection centre (3,)."""
    pose = image.cam_from_world().inverse()
    return np.asarray(pose.rotation.quat, dtype=np.float64), np.asarray(pose.translation, dtype=np.float64)
