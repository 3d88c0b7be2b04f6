"""Undistorted images and a model of pinhole cameras, as trainers of 3-D Gaussian splatting read them.

``images/NAME`` is the undistorted image, ``sparse/0`` holds ``cameras.bin``, ``images.bin`` and ``points3D.bin`` as
COLMAP wrote them before it knew rigs: each image has a pose and a PINHOLE camera of the undistorted image's size.
"""

from pathlib import Path, PurePosixPath

import pycolmap

from colmap_vg.colmap_io.reconstruction import write_model
from colmap_vg.errors import ImageFolderError, MappingError
from colmap_vg.exports.source import Source
from colmap_vg.features.photographs import Photograph, check_photograph, leads_out

SPARSE = Path("sparse") / "0"
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")


def write_splat(source: Source, folder: Path, max_image_size: int | None = None) -> list[str]:
    """Undistort the images and write the model of what they became.

    Parameters
    ----------
    source : Source
    folder : Path
    max_image_size : int, optional
        Longer side of the undistorted images, pixels; larger ones are made smaller.

    Returns
    -------
    list of str
        Notes on what trainers may not take.

    Raises
    ------
    ImageFolderError
        The photographs are not known, or one is missing, damaged, or of another size than its camera.
    MappingError
        A camera is spherical, a name leaves the folder, or an image cannot be undistorted.
    OutputError
        A file cannot be written.
    """
    photographs, images = source.photographs(), source.images()
    for image in images:
        _check(image, source.reconstruction.camera(image.camera_id), photographs)
    undistorted, options = folder / "undistorted", pycolmap.UndistortCameraOptions()
    if max_image_size is not None:
        options.max_image_size = max_image_size
    undistorted.mkdir()
    try:
        pycolmap.undistort_images(undistorted, source.folder, photographs, undistort_options=options)
        model = pycolmap.Reconstruction(undistorted / "sparse")
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        raise MappingError(f"COLMAP could not undistort the images of {source.folder} ({error})") from error
    for image in images:
        found = check_photograph(undistorted / "images" / image.name, image.name)
        camera = model.camera(image.camera_id)
        if not isinstance(found, Photograph) or (found.width, found.height) != (camera.width, camera.height):
            raise MappingError(
                f"COLMAP could not undistort {image.name!r} or not write it under this name: free disk space, or "
                "convert the photographs to JPEG or PNG files and map them again"
            )
    _publish(model, undistorted, folder)
    return _notes(model)


def _check(image: "pycolmap.Image", camera: "pycolmap.Camera", photographs: Path) -> None:
    """Check what COLMAP does not check, skips without an error, or aborts the process for."""
    if not PurePosixPath(image.name).parts or leads_out(image.name):
        raise MappingError(f"the image name {image.name!r} leads out of the output folder: rename the image")
    if camera.is_spherical():
        raise MappingError(f"{image.name!r} has a spherical camera, which no pinhole camera replaces")
    found = check_photograph(photographs / image.name, image.name)
    if not isinstance(found, Photograph):
        raise ImageFolderError(f"{photographs / image.name}: {found.reason}; check image_path")
    if (found.width, found.height) != (camera.width, camera.height):
        raise ImageFolderError(
            f"{photographs / image.name} has {found.width} x {found.height} pixels, and its camera "
            f"{camera.width} x {camera.height}: image_path must be the folder of the photographs that were mapped"
        )


def _publish(model: "pycolmap.Reconstruction", undistorted: Path, folder: Path) -> None:
    for camera in model.cameras.values():
        if camera.model_name == "SIMPLE_PINHOLE":  # COLMAP leaves such cameras as they are
            f, cx, cy = camera.params
            camera.model = pycolmap.CameraModelId.PINHOLE
            camera.params = [f, f, cx, cy]
    (folder / SPARSE).mkdir(parents=True)
    written = undistorted / "model"
    written.mkdir()
    write_model(model, written)
    for name in MODEL_FILES:
        (written / name).rename(folder / SPARSE / name)
    (undistorted / "images").rename(folder / "images")
    _remove(undistorted)


def _remove(folder: Path) -> None:
    """Remove what COLMAP writes for dense stereo."""
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    folder.rmdir()


def _notes(model: "pycolmap.Reconstruction") -> list[str]:
    names = [image.name for image in model.images.values()]
    notes = []
    if any("/" in name for name in names):
        notes.append("images lie in folders, which some trainers ignore: they look for images/FILE")
    if not all(name.isascii() for name in names):
        notes.append("names are not ASCII, which the original trainer cannot read")
    if model.num_points3D() == 0:
        notes.append("the model has no points, from which trainers start")
    return notes
