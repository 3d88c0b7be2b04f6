"""Demo: render photographs with known cameras, reconstruct them from the images alone, and compare with the truth."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.demo.photographs import RING_RADIUS, TrueCameras, render_photographs, true_cameras, write_truth
from colmap_vg.errors import OptionError, OutputError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.jobs.image_folder import DATABASE_NAME, make_database
from colmap_vg.jobs.mapper import MappingResult, map_database
from colmap_vg.jobs.output_folder import output_lock, work_folder
from colmap_vg.options import FeatureOptions, MappingOptions

__all__ = ["DemoResult", "render_photographs", "run_demo"]


@dataclass(frozen=True)
class DemoResult:
    """Errors of a model's cameras with respect to the true ones, after the best similarity.

    Attributes
    ----------
    num_images, num_registered : int
    ring_radius_m : float
        Mean radius of the ring of cameras, metres.
    mean_position_error_m, max_position_error_m : float
        Over registered images, metres.
    mean_position_error_share : float
        Mean position error as a share of the ring's radius.
    mean_rotation_error_deg : float
        Over registered images, degrees.
    focal_error_share : float
        Relative error of the median focal length, dimensionless.
    """

    num_images: int
    num_registered: int
    ring_radius_m: float
    mean_position_error_m: float
    max_position_error_m: float
    mean_position_error_share: float
    mean_rotation_error_deg: float
    focal_error_share: float

    @property
    def summary(self) -> str:
        """One sentence on the errors."""
        return (
            f"{self.num_registered} of {self.num_images} images registered; compared with the true cameras: mean"
            f" position error {1e3 * self.mean_position_error_m:.1f} mm ({self.mean_position_error_share:.3%} of the"
            f" ring's radius), mean rotation error {self.mean_rotation_error_deg:.3f} deg, focal length error"
            f" {self.focal_error_share:+.2%}"
        )


def run_demo(
    output_path: str | PathLike[str],
    *,
    num_images: int = 24,
    seed: int = 0,
    num_threads: int = -1,
    overwrite: bool = False,
    resume: bool = False,
    on_event: Callable[[StageEvent], None] | None = None,
) -> tuple[DemoResult, MappingResult]:
    """Render photographs, reconstruct them, and compare the model with the truth.

    Parameters
    ----------
    output_path : path
        Folder for ``images``, ``truth.txt``, ``database.db`` and the model ``0``.
    num_images : int
        At least 3.
    seed : int
        Random seed of the scene, the cameras, the noise and the reconstruction.
    num_threads : int
        -1: all cores.
    overwrite : bool
        Replace the files of an earlier demo in the output folder.
    resume : bool
        Reuse the photographs and the database of an interrupted demo with the same number of images and seed.
    on_event : callable, optional
        Called with a `StageEvent` whenever a stage starts, progresses, ends or warns.

    Returns
    -------
    DemoResult, MappingResult

    Raises
    ------
    OptionError
        There are too few images.
    ColmapVgError
        As for `image_folder_mapping`; also if open3d cannot be loaded.
    """
    if num_images < 3:
        raise OptionError(f"num_images is {num_images}: a model needs at least 3 images")
    output, log = Path(output_path), StageLog(on_event)
    image_path = output / "images"
    with output_lock(output):
        cameras = _photographs(output, num_images, seed, num_threads, log, overwrite=overwrite, resume=resume)
        features = FeatureOptions(num_threads=num_threads, random_seed=seed)
        make_database(image_path, output, features, log, overwrite=overwrite, resume=resume)
        options = MappingOptions(num_threads=num_threads, random_seed=seed, overwrite=overwrite)
        mapped = map_database(output / DATABASE_NAME, image_path, output, options, log)
    return compared(mapped.models[0], cameras), mapped


def _photographs(
    output: Path, num_images: int, seed: int, num_threads: int, log: StageLog, *, overwrite: bool, resume: bool
) -> TrueCameras:
    """Render the photographs to ``output/images`` atomically, or reuse them on resume; return their cameras."""
    image_path = output / "images"
    with work_folder(output, overwrite) as work:
        record, made = work / "photographs.json", json.dumps({"num_images": num_images, "seed": seed})
        try:
            if resume and image_path.exists() and record.exists() and record.read_text(encoding="utf-8") == made:
                log.progress(f"reusing {image_path}")
                return true_cameras(num_images, seed)
            if image_path.exists() and not overwrite and not record.exists():
                raise OutputError(f"{image_path} exists: choose another --output_path, or replace it with --overwrite")
            rendered = work / "images"
            shutil.rmtree(rendered, ignore_errors=True)
            rendered.mkdir()
            with log.stage("render"):
                cameras = render_photographs(
                    rendered,
                    num_images=num_images,
                    seed=seed,
                    num_threads=num_threads,
                    on_image=lambda done: log.progress(f"{done} of {num_images} photographs", done / num_images, done),
                )
                write_truth(output / "truth.txt", cameras)
                if image_path.exists():
                    shutil.rmtree(image_path)
                record.write_text(made, encoding="utf-8")
                rendered.rename(image_path)
                log.result(f"{num_images} photographs in {image_path}")
        except OSError as error:
            raise OutputError(f"cannot write {image_path}: {error.strerror}; choose another --output_path") from error
    return cameras


def compared(model: "pycolmap.Reconstruction", cameras: TrueCameras) -> DemoResult:
    """Compute the errors of a model's cameras after the similarity that best maps their positions to the true ones."""
    row_of = {name: row for row, name in enumerate(cameras.names)}
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    rows = [row_of[image.name] for image in images]
    errors, similarity = align_positions(
        np.array([image.projection_center() for image in images]), cameras.centers[rows]
    )
    rotations = np.array([image.cam_from_world().rotation.matrix() for image in images]) @ similarity.rotation.T
    turned = so3.angle(rotations @ np.swapaxes(cameras.rotations[rows], 1, 2))
    focals = [model.camera(image.camera_id).mean_focal_length() for image in images]
    return DemoResult(
        num_images=len(cameras.names),
        num_registered=len(images),
        ring_radius_m=RING_RADIUS,
        mean_position_error_m=float(errors.mean()),
        max_position_error_m=float(errors.max()),
        mean_position_error_share=float(errors.mean() / RING_RADIUS),
        mean_rotation_error_deg=float(np.degrees(turned.mean())),
        focal_error_share=float(np.median(focals) / cameras.camera.mean_focal_length() - 1.0),
    )
