"""Read a viewing graph from a COLMAP database: all images, and all verified pairs with a verdict each."""

from dataclasses import replace
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length, has_radial_term, with_focal_scale
from colmap_vg.colmap_io.pair_lists import listed_edges
from colmap_vg.colmap_io.pose_priors import read_pose_priors
from colmap_vg.colmap_io.rigs import read_rigs
from colmap_vg.colmap_io.tables import DatabaseTables, read_tables
from colmap_vg.events import report_progress
from colmap_vg.linear.threads import single_threaded_blas
from colmap_vg.options import ReadOptions
from colmap_vg.reading.distortion import with_found_distortion
from colmap_vg.reading.fisheyes import with_found_fisheye_focals
from colmap_vg.reading.focals import FocalDecision, decide_focal_lengths
from colmap_vg.reading.found_lenses import FoundLenses, with_found_lenses
from colmap_vg.reading.given_model import explained_pairs, of_pairs, with_given_cameras, with_pairs_of_model
from colmap_vg.reading.relative_poses import relative_poses
from colmap_vg.reading.still_background import without_still_background
from colmap_vg.reading.verification import with_verified_geometries
from colmap_vg.scene.marked_pairs import with_marked_pairs
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.two_view.edge_information import MAX_NUM_STEPS
from colmap_vg.two_view.segments import evenly_thinned, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def read_view_graph(database_path: str | PathLike[str], options: ReadOptions | None = None) -> ViewGraph:
    """Read the viewing graph of a COLMAP database.

    Parameters
    ----------
    database_path : path
        A database with keypoints and verified matches, by COLMAP of any version or by another matcher. It is never
        modified.
    options : ReadOptions, optional

    Returns
    -------
    ViewGraph
        All images, and all pairs with verified matches; `read_verdicts` says which pairs may be used. Focal lengths
        that the pairs contradict, or that are only COLMAP's guess, are replaced by those found from the pairs
        (`camera_focal_lengths`, `camera_focal_known`).

    Raises
    ------
    DatabaseError
        The file cannot be read or is damaged.
    """
    graph, _ = read_with_caveats(database_path, ReadOptions.given(options))
    return graph


@single_threaded_blas
def read_with_caveats(
    database_path: str | PathLike[str],
    options: ReadOptions,
    model: "pycolmap.Reconstruction | None" = None,
    lenses: FoundLenses | None = None,
) -> tuple[ViewGraph, tuple[str, ...]]:
    """Read the viewing graph, and sentences on what was changed or could not be decided on reading.

    With a `model` of some of the images, its calibrations are used, and pairs that it explains get its relative poses.
    With the `lenses` of a first solution, relative poses are estimated with them.
    """
    tables = read_tables(database_path)
    if model is None:
        nothing = np.zeros(len(tables.cameras), dtype=bool)
        graph, caveats = _read(tables, database_path, options, nothing, lenses=lenses)
    else:
        tables, given = with_given_cameras(tables, model)
        explained, told = explained_pairs(tables, given, options)
        rest = of_pairs(tables, ~explained)  # only to check that poses agree: their own need not be refined
        graph, caveats = _read(rest, database_path, options, given.calibrated, max_num_steps=0)
        graph, caveats = with_pairs_of_model(graph, tables, explained, given), (*told, *caveats)
    priors, ignored = read_pose_priors(database_path, tables.image_ids.tolist())
    rigs = read_rigs(database_path, tables.image_ids)
    return replace(graph, priors=priors, rigs=rigs), (*caveats, *ignored)


def _read(
    tables: DatabaseTables,
    database_path: str | PathLike[str],
    options: ReadOptions,
    calibrated: BoolArray,
    *,
    lenses: FoundLenses | None = None,
    max_num_steps: int = MAX_NUM_STEPS,
) -> tuple[ViewGraph, tuple[str, ...]]:
    """Graph of the pairs of the tables; marked cameras (c,) keep their calibration."""
    terms, found = np.zeros(len(tables.cameras)), np.zeros(len(tables.cameras), dtype=bool)
    if lenses is not None:
        tables, terms, found = with_found_lenses(tables, database_path, lenses)
    verified, unverified = found.copy(), np.zeros_like(found) if lenses is None else found & lenses.verified_anew
    report_progress("distortion")
    if options.find_distortion:
        tables, more = with_found_distortion(tables, database_path, calibrated | found)
        terms = terms + more
    report_progress("focal lengths")
    tables, replaced = with_found_fisheye_focals(tables, database_path, options, calibrated | found)
    found |= replaced
    report_progress("still background")
    tables, thinned = without_still_background(tables, database_path)
    report_progress("verification")
    expected = thinned | (found | (terms != 0.0))[tables.camera_idx[tables.pairs]].any(axis=1)
    cameras = tables.camera_idx[tables.pairs]
    inliers = verified[cameras].any(axis=1) & ~unverified[cameras].any(axis=1) & ~thinned
    tables, changed = with_verified_geometries(tables, options.random_seed, expected, inliers)
    changed |= thinned
    report_progress("focal lengths")
    focals = decide_focal_lengths(tables, options, calibrated, found)
    report_progress("relative poses")
    graph = _graph(tables, focals, changed, terms, options, max_num_steps)
    return graph, (*tables.caveats, *focals.caveats)


def _graph(
    tables: DatabaseTables,
    focals: FocalDecision,
    changed: BoolArray,
    terms: Array,
    options: ReadOptions,
    max_num_steps: int,
) -> ViewGraph:
    cameras = [with_focal_scale(c, s) for c, s in zip(tables.cameras, focals.scales, strict=True)]
    offsets, matches, bearings1, bearings2 = _rays_of_matches(tables, cameras)
    report_progress("relative poses")
    geometry = relative_poses(
        tables, focals.scales, focals.known, offsets, bearings1, bearings2, options, max_num_steps
    )
    report_progress("relative poses")
    num_inliers = np.diff(offsets)
    thin = evenly_thinned(offsets, options.max_num_inliers_per_edge)
    graph = ViewGraph(
        image_ids=tables.image_ids,
        edges=tables.pairs,
        cam2_from_cam1_rotations=geometry.rotations,
        cam2_in_cam1_directions=geometry.directions,
        num_inliers=num_inliers,
        camera_idx=tables.camera_idx,
        image_names=tables.image_names,
        camera_ids=np.array([c.camera_id for c in cameras], dtype=np.int64),
        camera_focal_lengths=np.array([focal_length(c) for c in cameras]),
        camera_focal_known=focals.known,
        camera_radial=np.array([has_radial_term(c) for c in cameras], dtype=bool),
        read_verdicts=geometry.verdicts,
        found_radial_terms=terms if terms.any() else None,
        verified_anew=changed if changed.any() else None,
        planar=geometry.planar,
        triangulation_angles=geometry.angles,
        edge_information=geometry.information,
        inlier_offsets=segment_subset(offsets, thin),
        inlier_bearings1=bearings1[thin],
        inlier_bearings2=bearings2[thin],
        inlier_keypoints1=matches[thin, 0].astype(np.int32),
        inlier_keypoints2=matches[thin, 1].astype(np.int32),
    )
    listed = (options.excluded_pairs_path, options.trusted_pairs_path)
    return with_marked_pairs(graph, *(listed_edges(path, tables.image_names, tables.pairs) for path in listed))


def _rays_of_matches(
    tables: DatabaseTables, cameras: list["pycolmap.Camera"]
) -> tuple[IntArray, IntArray, Array, Array]:
    """Offsets, keypoint indices and unit rays of the matches that have rays in both images."""
    starts = np.concatenate([[0], np.cumsum([len(k) for k in tables.keypoints])]).astype(np.int64)
    rays, valid = np.zeros((int(starts[-1]), 3)), np.zeros(int(starts[-1]), dtype=bool)
    for camera_row, camera in enumerate(cameras):
        report_progress("rays")
        images = np.flatnonzero(tables.camera_idx == camera_row)
        points = np.concatenate([np.zeros((0, 2))] + [tables.keypoints[i] for i in images])
        found, good = bearings_of_keypoints(camera, points)
        rows = np.concatenate([np.zeros(0, dtype=np.int64)] + [np.arange(starts[i], starts[i + 1]) for i in images])
        rays[rows], valid[rows] = found, good
    report_progress("rays")
    image = np.repeat(tables.pairs, np.diff(tables.offsets), axis=0)
    rows = starts[image] + tables.matches
    keep = np.asarray(valid[rows].all(axis=1))
    return segment_subset(tables.offsets, keep), tables.matches[keep], rays[rows[keep, 0]], rays[rows[keep, 1]]
