"""Extend an existing model by the other images of a database, with its cameras fixed or adjusted too."""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.loading import loaded_reconstruction, with_other_images
from colmap_vg.errors import DataFileError
from colmap_vg.events import StageLog
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.mapping.build import BuildResult, finish_registration, settle_given_poses, triangulated
from colmap_vg.mapping.bundle import held_of
from colmap_vg.mapping.options import mapper_options
from colmap_vg.mapping.pair_agreement import PairRotations
from colmap_vg.options import MappingOptions

Array = NDArray[np.float64]

NUM_COMPARED, SAME_KEYPOINT_PX = 20, 0.01
"""Number of keypoints of each image that are compared, and maximum distance between those that are the same, pixels."""
NUM_OBSERVATIONS_TO_REGISTER = 250
"""Observations of an image that suffice to register it before bundle adjustment."""


def read_input_model(input_path: str | PathLike[str]) -> "pycolmap.Reconstruction":
    """Read a model to start from.

    Parameters
    ----------
    input_path : path
        Folder of a COLMAP model, binary or text.

    Raises
    ------
    DataFileError
        The model cannot be read, or has fewer than two registered images.
    """
    if not Path(input_path).is_dir():
        raise DataFileError(f"{input_path}: no such folder; input_path is the folder of a COLMAP model")
    try:
        model = pycolmap.Reconstruction(input_path)
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        raise DataFileError(f"{input_path}: is no COLMAP model that can be read ({error})") from error
    if model.num_reg_images() < 2:
        raise DataFileError(
            f"{input_path}: has {model.num_reg_images()} registered images; a model to start from needs two"
        )
    return model


def check_image_names(model: "pycolmap.Reconstruction", image_names: Iterable[str]) -> None:
    """Check that a database has all registered images of a model to start from.

    Raises
    ------
    DataFileError
        It lacks some.
    """
    names = {model.image(image_id).name for image_id in model.reg_image_ids()}
    lacking = sorted(names.difference(image_names))
    if lacking:
        raise DataFileError(
            f"{len(lacking)} of the {len(names)} images of the model to start from are not in the database (first:"
            f" {lacking[0]}); match all images in one database, under the names that they have in the model"
        )


def extend_model(
    cache: "pycolmap.DatabaseCache",
    given: "pycolmap.Reconstruction",
    options: MappingOptions,
    log: StageLog,
    pairs: PairRotations,
) -> tuple["pycolmap.Reconstruction", BuildResult]:
    """Register a database's other images in an existing model.

    With `fix_existing_frames` the model's poses and calibrations stay as they are, else they are adjusted and the
    result is aligned to them.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    given : pycolmap.Reconstruction
        From `read_input_model`.
    options : MappingOptions
    log : StageLog
    pairs : PairRotations
        Of the database, to check the added images against.

    Returns
    -------
    reconstruction : pycolmap.Reconstruction
        In the frame of the given model.
    result : BuildResult
    """
    with log.stage("extend"):
        model = loaded_reconstruction(cache)
        ids = {image.name: image_id for image_id, image in model.images.items()}
        old = {image_id: ids[given.image(image_id).name] for image_id in sorted(given.reg_image_ids())}
        if _is_part_of(given, model):
            model = pycolmap.Reconstruction(given)
            with_other_images(model, cache)
            copied = model.num_points3D()
        else:
            _copy_cameras(given, model, old, log)
            _copy_poses(given, model, old)
            copied = _copy_points(given, model, old)
        log.result(f"{len(old)} images and {copied} points of the given model")
        placed = _registered_by_sample(cache, model, options)
    if copied == 0:
        model = triangulated(cache, model, log)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    frames = {model.image(image_id).frame_id for image_id in old.values()}
    # Images of given frames would move with the places of their sensors.
    held = held_of(model, frozenset(frames)) if options.fix_existing_frames else held_of(cache)
    if copied == 0:
        settle_given_poses(mapper, options, held)
    result = finish_registration(mapper, options, log, pairs, held, frozenset(frames), placed)
    mapper.end_reconstruction(False)
    if not options.fix_existing_frames:
        _align(given, model, old)
    model.update_point_3d_errors()
    return model, result


def _copy_cameras(
    given: "pycolmap.Reconstruction", model: "pycolmap.Reconstruction", old: dict[int, int], log: StageLog
) -> None:
    """Give the database's cameras the calibrations of the given model's, and warn of cameras with several."""
    done: dict[int, int] = {}
    several = set()
    for image_id, new_id in old.items():
        camera_id, camera = model.image(new_id).camera_id, given.camera(given.image(image_id).camera_id)
        if done.setdefault(camera_id, camera.camera_id) == camera.camera_id:
            target = model.camera(camera_id)
            target.model, target.params = camera.model, camera.params.tolist()
        else:
            several.add(camera_id)
    if several:
        log.warn(
            f"{len(several)} cameras of the database have several calibrations in the given model (first:"
            f" {min(several)}); that of their first image is taken."
        )


def _copy_poses(given: "pycolmap.Reconstruction", model: "pycolmap.Reconstruction", old: dict[int, int]) -> None:
    for rig in given.rigs.values():
        for sensor in rig.non_ref_sensors:
            pose = rig.sensor_from_rig(sensor)
            own = [r for r in model.rigs.values() if r.has_sensor(sensor) and not r.is_ref_sensor(sensor)]
            if pose is not None and own:
                own[0].set_sensor_from_rig(sensor, pose)
    for image_id, new_id in old.items():
        image = model.image(new_id)
        frame = model.frame(image.frame_id)
        if not frame.has_pose():
            frame.set_cam_from_world(image.camera_id, given.image(image_id).cam_from_world())
            model.register_frame(image.frame_id)


def _is_part_of(given: "pycolmap.Reconstruction", whole: "pycolmap.Reconstruction") -> bool:
    """Whether all that a model holds has the same ids, and its images the same keypoints, in that of the database."""
    for image_id, image in given.images.items():
        if not whole.exists_image(image_id):
            return False
        own = whole.image(image_id)
        if (own.name, own.camera_id, own.frame_id) != (image.name, image.camera_id, image.frame_id):
            return False
        if not _same_keypoints(image, own):
            return False
    frames = all(
        whole.exists_frame(frame_id) and _contents(frame) == _contents(whole.frame(frame_id))
        for frame_id, frame in given.frames.items()
    )
    return frames and all(
        whole.exists_rig(rig_id) and _has_places_of(rig, whole.rig(rig_id)) for rig_id, rig in given.rigs.items()
    )


def _contents(frame: "pycolmap.Frame") -> tuple[int, list[int]]:
    return frame.rig_id, sorted(data.id for data in frame.image_ids)


def _has_places_of(given: "pycolmap.Rig", own: "pycolmap.Rig") -> bool:
    """Whether a rig has the sensors of the database's, and their places where that knows them."""
    ids = [(rig.ref_sensor_id.id, sorted(sensor.id for sensor in rig.non_ref_sensors)) for rig in (given, own)]
    return ids[0] == ids[1] and all(
        given.has_sensor_from_rig(sensor) or not own.has_sensor_from_rig(sensor) for sensor in own.non_ref_sensors
    )


def _same_keypoints(one: "pycolmap.Image", other: "pycolmap.Image") -> bool:
    """Whether two images have as many keypoints, and a sample of them is at the same places."""
    count = one.num_points2D()
    if other.num_points2D() != count:
        return False
    places = range(0, count, max(count // NUM_COMPARED, 1))
    keypoints, same = ([image.point2D(place).xy for place in places] for image in (one, other))
    return bool(np.abs(np.subtract(keypoints, same)).max(initial=0.0) <= SAME_KEYPOINT_PX)


def _copy_points(given: "pycolmap.Reconstruction", model: "pycolmap.Reconstruction", old: dict[int, int]) -> int:
    """Copy the points if the keypoints of all images are the database's; return their number."""
    if not all(_same_keypoints(given.image(image_id), model.image(new_id)) for image_id, new_id in old.items()):
        return 0
    same_ids = all(image_id == new_id for image_id, new_id in old.items())
    for _, point in sorted(given.points3D.items()):
        track = point.track if same_ids else _renumbered(point.track, old)
        model.add_point3D(np.asarray(point.xyz), track, np.asarray(point.color))
    return int(given.num_points3D())


def _renumbered(track: "pycolmap.Track", old: dict[int, int]) -> "pycolmap.Track":
    renumbered = pycolmap.Track()
    for element in track.elements:
        renumbered.add_element(old[element.image_id], element.point2D_idx)
    return renumbered


def _registered_by_sample(
    cache: "pycolmap.DatabaseCache", model: "pycolmap.Reconstruction", options: MappingOptions
) -> dict[int, "pycolmap.Rigid3d"]:
    """Poses of frames that a sample of a model's points tells, rig from world; none where the points are few.

    Bundle adjustment decides the final poses; to register an image by thousands of points takes ten times as long.
    Cameras that had no registered image get the calibrations that belong to the poses.
    """
    ids, images = sorted(model.point3D_ids()), max(model.num_reg_images(), 1)
    every = model.compute_num_observations() // (images * NUM_OBSERVATIONS_TO_REGISTER)
    if every < 2:
        return {}
    thinned = pycolmap.Reconstruction(model)
    kept = set(ids[::every])
    for point_id in ids:
        if point_id not in kept:
            thinned.delete_point3D(point_id)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(thinned)
    registration = mapper_options(options)
    candidates = mapper.find_next_images(registration, False)
    found = dict[int, "pycolmap.Rigid3d"]()
    for image_id in candidates:
        image = thinned.image(image_id)
        if image.frame_id not in found and mapper.register_next_image(registration, image_id):
            pose = thinned.frame(image.frame_id).rig_from_world
            if pose is not None:
                found[image.frame_id] = pycolmap.Rigid3d(pose.matrix())
            model.camera(image.camera_id).params = thinned.camera(image.camera_id).params.tolist()
    mapper.end_reconstruction(False)
    return found


def _align(given: "pycolmap.Reconstruction", model: "pycolmap.Reconstruction", old: dict[int, int]) -> None:
    """Move the adjusted model to where its cameras fit those of the given one best."""
    both = [(image_id, new_id) for image_id, new_id in old.items() if model.image(new_id).has_pose]
    centers = [np.array([m.image(pair[k]).projection_center() for pair in both]) for k, m in enumerate((given, model))]
    _, similarity = align_positions(centers[1], centers[0])
    rotation = pycolmap.Rotation3d(similarity.rotation)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
