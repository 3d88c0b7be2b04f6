"""Read a viewing graph beside a model that is given: pairs of its images are compared with it instead of estimated.

Most pairs of a database to which a few images were added are between images of the given model. Where their matches
agree with the model's cameras, their relative poses are the model's. All others are read as usual: pairs of new images,
and pairs that the model does not explain, so that they count against it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length
from colmap_vg.colmap_io.pair_lists import listed_edges
from colmap_vg.colmap_io.tables import DEGENERATE, WATERMARK, DatabaseTables
from colmap_vg.errors import DataFileError
from colmap_vg.geometry.directions import normalized
from colmap_vg.options import ReadOptions
from colmap_vg.reading.verification import MAX_ERROR_PX
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors
from colmap_vg.two_view.segments import evenly_thinned, rows_of_segments, segment_subset, segment_sums

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_SHARE_AGREEING = 0.8
"""Minimum share of a pair's matches within the threshold for the model to explain it."""
MIN_SHARE_EXPLAINED = 0.5
"""Minimum share of its pairs that a model explains, or else a warning: false pairs are fewer than the others."""
MAX_MATCHES_CHECKED = 100
"""Maximum number of a pair's matches that are compared with the model."""


@dataclass(frozen=True, eq=False)
class GivenCameras:
    """Poses and calibrations of a given model, in the rows of a database's images and cameras.

    Attributes
    ----------
    rotations : (n, 3, 3) array
        cam_from_world; NaN for images that the model does not contain.
    centers : (n, 3) array
        Projection centres, frame of the model; NaN likewise.
    calibrated : (c,) bool array
        Cameras of the database with the model's calibration.
    """

    rotations: Array
    centers: Array
    calibrated: BoolArray


def with_given_cameras(tables: DatabaseTables, model: "pycolmap.Reconstruction") -> tuple[DatabaseTables, GivenCameras]:
    """Find a model's poses by image names, and give the database's cameras its calibrations.

    A camera whose images have several calibrations in the model gets that of the first.

    Raises
    ------
    DataFileError
        A camera has another image size in the model.
    """
    rows = {name: row for row, name in enumerate(tables.image_names)}
    n = len(tables.image_ids)
    rotations, centers = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    cameras = list(tables.cameras)
    calibrated = np.zeros(len(cameras), dtype=bool)
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        row = rows.get(image.name)
        if row is None:
            continue
        rotations[row] = image.cam_from_world().rotation.matrix()
        centers[row] = image.projection_center()
        camera = int(tables.camera_idx[row])
        if not calibrated[camera]:
            calibrated[camera] = True
            cameras[camera] = _with_calibration(cameras[camera], model.camera(image.camera_id), image.name)
    return replace(tables, cameras=tuple(cameras)), GivenCameras(rotations, centers, calibrated)


def _with_calibration(camera: "pycolmap.Camera", given: "pycolmap.Camera", name: str) -> "pycolmap.Camera":
    if (given.width, given.height) != (camera.width, camera.height):
        raise DataFileError(
            f"{name}: {given.width} x {given.height} pixels in the given model, {camera.width} x {camera.height} in the"
            " database; extract features from the photographs that the model was made of, or scale its cameras"
        )
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model=given.model,
        width=camera.width,
        height=camera.height,
        params=given.params,
        has_prior_focal_length=True,
    )


def of_pairs(tables: DatabaseTables, chosen: BoolArray) -> DatabaseTables:
    """Tables with the marked pairs (m,) and their matches only; images and keypoints stay."""
    rows, offsets = rows_of_segments(tables.offsets, np.flatnonzero(chosen))
    columns = ("pairs", "configs", "F", "E", "H", "rotations", "translations")
    kept = {name: getattr(tables, name)[chosen] for name in columns}
    return replace(tables, matches=tables.matches[rows], offsets=offsets, **kept)


def explained_pairs(
    tables: DatabaseTables, given: GivenCameras, options: ReadOptions
) -> tuple[BoolArray, tuple[str, ...]]:
    """Pairs of two given images most of whose matches agree with the model.

    Parameters
    ----------
    tables : DatabaseTables
        With the model's calibrations.
    given : GivenCameras
    options : ReadOptions
        Pairs with fewer matches than `min_num_inliers`, and those on the list of excluded ones, are read as usual.

    Returns
    -------
    explained : (m,) bool array
    caveats : tuple of str
        A sentence if the model explains too few of its pairs.
    """
    has_pose = np.asarray(np.isfinite(given.centers).all(axis=1))
    chosen = np.asarray(has_pose[tables.pairs].all(axis=1))
    chosen &= ~np.isin(tables.configs, (DEGENERATE, WATERMARK))
    chosen &= np.diff(tables.offsets) >= max(options.min_num_inliers, 1)
    chosen &= ~listed_edges(options.excluded_pairs_path, tables.image_names, tables.pairs)
    part = of_pairs(tables, chosen)
    few = evenly_thinned(part.offsets, MAX_MATCHES_CHECKED)
    part = replace(part, matches=part.matches[few], offsets=segment_subset(part.offsets, few))
    rays1, rays2, valid = _rays(part)
    rotations, directions = _relative_poses(part.pairs, given)
    focals = np.array([focal_length(camera) for camera in part.cameras])[part.camera_idx]
    errors = sampson_errors(
        essential_from_pose(rotations, directions),
        part.offsets,
        rays1,
        rays2,
        focals[part.pairs[:, 0]],
        focals[part.pairs[:, 1]],
    )
    agree = segment_sums(part.offsets, (valid & (np.abs(errors) <= MAX_ERROR_PX)).astype(np.float64))
    good = agree >= MIN_SHARE_AGREEING * np.diff(part.offsets)
    chosen[chosen] = good
    if good.sum() >= MIN_SHARE_EXPLAINED * len(good):
        return chosen, ()
    return chosen, (
        f"The given model explains only {int(good.sum())} of {len(good)} pairs of its images: matches of the others are"
        f" more than {MAX_ERROR_PX:.0f} px from where its cameras put them. Its poses or calibrations are not those of"
        " these photographs, or are rough and have to be adjusted (with fix_existing_frames off).",
    )


def with_pairs_of_model(
    graph: ViewGraph, tables: DatabaseTables, explained: BoolArray, given: GivenCameras
) -> ViewGraph:
    """Add the pairs that a model explains to a graph of the others.

    Parameters
    ----------
    graph : ViewGraph
        Of ``of_pairs(tables, ~explained)``.
    tables : DatabaseTables
        Of all m pairs.
    explained : (m,) bool array
    given : GivenCameras

    Returns
    -------
    ViewGraph
        With all pairs in the order of the tables. Explained ones have the relative poses of the model, no information
        on their precision, and no bearings.
    """
    rotations, directions = _relative_poses(tables.pairs[explained], given)

    of_explained: dict[str, object] = {
        "cam2_from_cam1_rotations": rotations,
        "cam2_in_cam1_directions": directions,
        "num_inliers": np.diff(tables.offsets)[explained],
        "read_verdicts": str(EdgeVerdict.KEPT),
        "trusted": False,
        "verified_anew": False,
        "planar": False,
        "triangulation_angles": np.nan,
        "edge_information": 0.0,
    }
    fields: dict[str, Any] = {"edges": tables.pairs}
    for name, values in of_explained.items():
        of_others = getattr(graph, name)
        if of_others is not None:
            fields[name] = np.empty((len(explained), *of_others.shape[1:]), dtype=of_others.dtype)
            fields[name][~explained], fields[name][explained] = of_others, values
    if graph.inlier_offsets is not None:
        lengths = np.zeros(len(explained), dtype=np.int64)
        lengths[~explained] = np.diff(graph.inlier_offsets)
        fields["inlier_offsets"] = np.concatenate([[0], np.cumsum(lengths)])
    return replace(graph, **fields)


def _relative_poses(pairs: IntArray, given: GivenCameras) -> tuple[Array, Array]:
    """cam2_from_cam1 rotations (p, 3, 3) and unit directions (p, 3) of camera 2 in camera 1's frame."""
    i, j = pairs.T
    rotations = given.rotations[j] @ np.swapaxes(given.rotations[i], 1, 2)
    baselines = np.einsum("kab,kb->ka", given.rotations[i], given.centers[j] - given.centers[i])
    return rotations, normalized(baselines)


def _rays(tables: DatabaseTables) -> tuple[Array, Array, BoolArray]:
    """Unit rays of the matched keypoints in both images (k, 3), and whether both have one (k,)."""
    image = np.repeat(tables.pairs, np.diff(tables.offsets), axis=0)
    starts = np.concatenate([[0], np.cumsum([len(points) for points in tables.keypoints])]).astype(np.int64)
    pixels = np.concatenate([*tables.keypoints, np.zeros((0, 2))]).astype(np.float64)
    rays, valid = np.zeros((2, len(image), 3)), np.zeros((2, len(image)), dtype=bool)
    for side in (0, 1):
        rows = starts[image[:, side]] + tables.matches[:, side]
        for row, camera in enumerate(tables.cameras):
            own = tables.camera_idx[image[:, side]] == row
            rays[side, own], valid[side, own] = bearings_of_keypoints(camera, pixels[rows[own]])
    return rays[0], rays[1], np.asarray(valid.all(axis=0))
