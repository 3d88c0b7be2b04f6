"""Turn a pose solution into a `pycolmap.Reconstruction` with the database's cameras, rigs, frames, images and ids."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.colmap_io.cameras import focal_length, with_focal_scale, with_radial_term
from colmap_vg.colmap_io.database import working_copy
from colmap_vg.colmap_io.loading import loaded_reconstruction
from colmap_vg.colmap_io.rigs import store_separated
from colmap_vg.colmap_io.shared_cameras import merge_cameras
from colmap_vg.errors import DatabaseError, OutputError
from colmap_vg.scene.rigs import RigPoses, Rigs
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph


@contextmanager
def loaded_cache(
    database_path: str | PathLike[str],
    work_folder: Path,
    min_num_matches: int,
    shared: Sequence[Sequence[int]] = (),
    without_pairs: Sequence[tuple[int, int]] = (),
    graph: ViewGraph | None = None,
) -> Iterator[tuple["pycolmap.DatabaseCache", dict[int, int]]]:
    """Load a database into a COLMAP cache from a temporary copy, since pycolmap changes databases that it opens.

    Parameters
    ----------
    database_path : path
    work_folder : Path
        Folder for the copy.
    min_num_matches : int
        Pairs with fewer matches are not loaded.
    shared : sequence of sequence of int
        Groups of ids of cameras to merge, see `merge_cameras`.
    without_pairs : sequence of (int, int)
        Image ids of pairs that are not loaded.
    graph : ViewGraph, optional
        As read from the database: the matches of pairs that were verified again replace the database's, its cameras
        get the radial terms that were found, and its rigs those of the graph.

    Yields
    ------
    cache : pycolmap.DatabaseCache
    replaced : dict of int to int
        For each camera that was merged into another one, the id of that one.

    Raises
    ------
    DatabaseError
        The copy cannot be made, or pycolmap cannot read it.
    """
    copy = working_copy(database_path, work_folder)
    try:
        try:
            replaced: dict[int, int] = {}
            if graph is not None:
                _replace_matches(copy, graph)
                _add_radial_terms(copy, graph)
                if graph.rigs is not None:
                    store_separated(copy, graph.image_ids, graph.rigs)
            if without_pairs:
                _delete_pairs(copy, without_pairs)
            if shared:
                pycolmap.Database.open(copy).close()  # migrates an old schema to the current one
                replaced = merge_cameras(copy, shared)
            with pycolmap.Database.open(copy) as database:
                options = pycolmap.DatabaseCacheOptions(min_num_matches=min_num_matches, load_all_images=True)
                cache = pycolmap.DatabaseCache.create(database, options)
        except (ValueError, RuntimeError, IndexError, MemoryError, sqlite3.Error) as error:
            # MemoryError, too, since a damaged row may request any amount of memory.
            raise DatabaseError(f"{database_path}: pycolmap cannot read the database ({error})") from error
        yield cache, replaced
    finally:
        for leftover in work_folder.glob(copy.name + "*"):
            leftover.unlink()


def _replace_matches(copy: Path, graph: ViewGraph) -> None:
    """Store the new matches of pairs that were verified again, with a configuration that COLMAP loads."""
    offsets, keypoints1, keypoints2 = graph.inlier_offsets, graph.inlier_keypoints1, graph.inlier_keypoints2
    if graph.verified_anew is None or offsets is None or keypoints1 is None or keypoints2 is None:
        return
    rows = []
    for edge in np.flatnonzero(graph.verified_anew).tolist():
        own = slice(*offsets[edge : edge + 2].tolist())
        matches = np.stack([keypoints1[own], keypoints2[own]], axis=1).astype(np.uint32)
        pair_id = pycolmap.image_pair_to_pair_id(*graph.image_ids[graph.edges[edge]].tolist())
        config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
        rows.append((len(matches), matches.tobytes(), config, pair_id))
    with closing(sqlite3.connect(copy)) as connection, connection:
        connection.executemany("UPDATE two_view_geometries SET rows = ?, data = ?, config = ? WHERE pair_id = ?", rows)


def _add_radial_terms(copy: Path, graph: ViewGraph) -> None:
    """Store the radial terms that were found on reading in the cameras."""
    if graph.found_radial_terms is None or graph.camera_ids is None:
        return
    with pycolmap.Database.open(copy) as database:
        for camera_id, term in zip(graph.camera_ids.tolist(), graph.found_radial_terms.tolist(), strict=True):
            if term:
                database.update_camera(with_radial_term(database.read_camera(camera_id), term))


def _delete_pairs(copy: Path, pairs: Sequence[tuple[int, int]]) -> None:
    pair_ids = [(pycolmap.image_pair_to_pair_id(*pair),) for pair in pairs]
    with closing(sqlite3.connect(copy)) as connection, connection:
        connection.executemany("DELETE FROM two_view_geometries WHERE pair_id = ?", pair_ids)


def reconstruction_from_solution(
    cache: "pycolmap.DatabaseCache",
    solution: PoseSolution,
    graph: ViewGraph,
    component: int = 0,
    rig_poses: RigPoses | None = None,
) -> "pycolmap.Reconstruction":
    """Make a reconstruction with the poses of one component, without points.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
        Of the database that the graph was read from.
    solution : PoseSolution
        Its focal factors multiply the graph's focal lengths.
    graph : ViewGraph
    component : int
    rig_poses : RigPoses, optional
        Poses of the component's frames and sensors, for a graph with rigs; the model gets the unit of known rigs.

    Returns
    -------
    pycolmap.Reconstruction
        All images of the database; those of the component have poses.
    """
    reconstruction = loaded_reconstruction(cache)
    if graph.camera_ids is not None and graph.camera_focal_lengths is not None:
        terms = np.zeros(len(graph.camera_ids)) if solution.radial_terms is None else solution.radial_terms
        for camera_id, focal, scale, term in zip(
            graph.camera_ids.tolist(), graph.camera_focal_lengths, solution.focal_scales, terms.tolist(), strict=True
        ):
            if reconstruction.exists_camera(camera_id):
                camera = reconstruction.camera(camera_id)
                factor = float(focal * scale / focal_length(camera))
                # Left alone where nothing changed, so that given calibrations stay identical to the last bit.
                if abs(factor - 1.0) > 1e-12 and not camera.is_spherical():
                    camera.params = with_focal_scale(camera, factor).params.tolist()
                if term != 0.0:
                    camera.params = with_radial_term(camera, term).params.tolist()
    if graph.rigs is not None and rig_poses is not None:
        _register_frames(reconstruction, graph.rigs, rig_poses)
        return reconstruction
    for row in np.flatnonzero(solution.component == component):
        R, center = solution.cam_from_world_rotations[row], solution.projection_centers[row]
        image = reconstruction.image(int(solution.image_ids[row]))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center)
        frame = reconstruction.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, pose)
        reconstruction.register_frame(image.frame_id)
    return reconstruction


def _register_frames(reconstruction: "pycolmap.Reconstruction", rigs: Rigs, found: RigPoses) -> None:
    """Register frames with averaged poses, and set those of sensors that the database does not know."""
    for row in np.flatnonzero(found.posed_sensors & ~rigs.known).tolist():
        R = found.sensor_rotations[row]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ found.sensor_centers[row] * found.scale)
        sensor = reconstruction.camera(int(rigs.camera_ids[row])).sensor_id
        reconstruction.rig(int(rigs.rig_ids[row])).set_sensor_from_rig(sensor, pose)
    # A frame with an image whose sensor has no place cannot be registered.
    lost = np.bincount(
        rigs.frame_idx, weights=~(found.posed_sensors | rigs.known)[rigs.sensor_idx], minlength=rigs.num_frames
    )
    for row in np.flatnonzero(found.posed_frames & (lost == 0)).tolist():
        R = found.frame_rotations[row]
        frame = reconstruction.frame(int(rigs.frame_ids[row]))
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ found.frame_centers[row] * found.scale)
        reconstruction.register_frame(frame.frame_id)


def write_model(reconstruction: "pycolmap.Reconstruction", folder: Path) -> None:
    """Write a model in COLMAP's binary format, and check that the files are complete.

    COLMAP does not check whether its files could be written: on a full disk they are truncated, and it reads them
    without an error. So their sizes are compared with the minimum size of the model.

    Raises
    ------
    OutputError
        A file cannot be written, or is incomplete.
    """
    try:
        reconstruction.write(folder)
        found = {path.name: path.stat().st_size for path in folder.iterdir()}
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"cannot write a model to {folder} ({error}); choose another output_path") from error
    expected = _file_sizes(reconstruction)
    short = [name for name, size in expected.items() if found.get(name, 0) < size]
    if short:
        raise OutputError(
            f"{folder / short[0]} has {found.get(short[0], 0)} of {expected[short[0]]} bytes: the disk is full, or a"
            " limit on the size of files was reached; free disk space or choose another output_path"
        )


def _file_sizes(reconstruction: "pycolmap.Reconstruction") -> dict[str, int]:
    """Sizes of the files of a model in COLMAP's binary format, bytes; all its numbers have a fixed width."""
    cameras = reconstruction.cameras.values()
    images = [reconstruction.image(image_id) for image_id in reconstruction.reg_image_ids()]
    return {
        "cameras.bin": 8 + sum(24 + 8 * len(camera.params) for camera in cameras),
        "images.bin": 8 + sum(73 + len(image.name.encode()) + 24 * image.num_points2D() for image in images),
        "points3D.bin": 8 + 51 * reconstruction.num_points3D() + 8 * reconstruction.compute_num_observations(),
        "frames.bin": 8 + 84 * reconstruction.num_reg_frames(),
        "rigs.bin": 8 + 16 * reconstruction.num_rigs(),
    }
