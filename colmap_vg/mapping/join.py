"""Join two models that share points: estimate the similarity between them, and transform both into one frame."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.cameras import bearings_of_keypoints, focal_length
from colmap_vg.geometry.similarity import Similarity
from colmap_vg.mapping.point_similarity import SeenPoints, similarity_of_points
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_AGREEING = 10
"""Minimum number of points that agree with the similarity in both models; three determine it, and a wrong point agrees
by chance once in 10^4."""
MIN_SHARE_AGREEING = 0.5
"""Minimum share of the shared points that agree: with fewer, another similarity may have as many."""
MIN_FLATNESS = 0.05
"""Minimum ratio of the second to the first singular value of the points that agree: collinear points do not determine
the rotation about their line."""
NO_POINT = np.iinfo(np.uint64).max


@dataclass(frozen=True, eq=False)
class Joint:
    """Similarity between two models and its support.

    Attributes
    ----------
    num_shared, num_agreeing : int
        Number of point pairs that verified matches identify as the same point, and of those that agree with the
        similarity.
    similarity : Similarity or None
        From the second model's frame to the first's; None where too few points agree.
    """

    num_shared: int
    num_agreeing: int
    similarity: Similarity | None


def joint_of(
    own: "pycolmap.Reconstruction",
    other: "pycolmap.Reconstruction",
    graph: ViewGraph,
    usable: BoolArray,
    seed: int = 0,
) -> Joint:
    """Estimate the similarity between two models from points that verified matches identify as the same.

    Parameters
    ----------
    own, other : pycolmap.Reconstruction
        Of the same database, with points.
    graph : ViewGraph
        With the keypoints of the matches of all pairs.
    usable : (m,) bool array
        Edges of the graph whose matches are used.
    seed : int

    Returns
    -------
    Joint
    """
    identified = list(_identified(own, other, graph, usable))
    if not identified:
        return Joint(0, 0, None)
    rows = np.concatenate(identified)
    _, first = np.unique(rows[:, :2], axis=0, return_index=True)
    rows = rows[np.sort(first)]
    points = (
        _seen_points(own, rows[:, 0], rows[:, 2], rows[:, 4]),
        _seen_points(other, rows[:, 1], rows[:, 3], rows[:, 5]),
    )
    similarity, agree = similarity_of_points(*points, seed)
    count = int(agree.sum())
    firm = count >= max(MIN_AGREEING, MIN_SHARE_AGREEING * len(rows)) and is_spread(points[0].points[agree])
    return Joint(len(rows), count, similarity if firm else None)


def joined_poses(
    empty: "pycolmap.Reconstruction",
    own: "pycolmap.Reconstruction",
    other: "pycolmap.Reconstruction",
    similarity: Similarity,
) -> "pycolmap.Reconstruction":
    """Collect both models' cameras and poses in the frame of the first, without points.

    Parameters
    ----------
    empty : pycolmap.Reconstruction
        With all images of the database, none registered; it is filled in place.
    own, other : pycolmap.Reconstruction
        Cameras in both models get the parameters of the first.
    similarity : Similarity
        From the second model's frame to the first's.
    """
    for model in (other, own):
        for camera_id in sorted({model.image(i).camera_id for i in model.reg_image_ids()}):
            empty.camera(camera_id).params = model.camera(camera_id).params.tolist()
    for model, moved in ((own, Similarity(1.0, np.eye(3), np.zeros(3))), (other, similarity)):
        _place_sensors(empty, model, moved.scale)
        for frame_id in sorted(model.reg_frame_ids()):
            pose = model.frame(frame_id).rig_from_world
            if pose is None:
                continue
            R = pose.rotation.matrix()
            center = moved.apply(-(R.T @ pose.translation)[None])[0]
            R = R @ moved.rotation.T
            empty.frame(frame_id).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center)
            empty.register_frame(frame_id)
    return empty


def _place_sensors(empty: "pycolmap.Reconstruction", model: "pycolmap.Reconstruction", scale: float) -> None:
    """Give sensors without a place in their rig that of a model."""
    for rig_id, rig in sorted(model.rigs.items()):
        for sensor in rig.non_ref_sensors:
            pose = rig.sensor_from_rig(sensor) if rig.has_sensor_from_rig(sensor) else None
            if pose is not None and not empty.rig(rig_id).has_sensor_from_rig(sensor):
                scaled = pycolmap.Rigid3d(pose.rotation, scale * np.asarray(pose.translation))
                empty.rig(rig_id).set_sensor_from_rig(sensor, scaled)


def is_spread(points: Array) -> bool:
    """Whether points (k, 3) determine a similarity, that is, are not collinear."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[1] >= MIN_FLATNESS * singular[0])


def _identified(
    own: "pycolmap.Reconstruction", other: "pycolmap.Reconstruction", graph: ViewGraph, usable: BoolArray
) -> Iterator[IntArray]:
    """For each pair between the models, rows of the ids of two identified points, their images, and their keypoints.

    The columns are: point in own, point in other, image in own, image in other, keypoint in own, keypoint in other.
    """
    offsets, keypoints1, keypoints2 = graph.inlier_offsets, graph.inlier_keypoints1, graph.inlier_keypoints2
    if offsets is None or keypoints1 is None or keypoints2 is None:
        return
    ids = graph.image_ids[graph.edges]
    sides = [np.isin(ids, sorted(model.reg_image_ids())) for model in (own, other)]
    # An image that both models registered by its points may be at either end.
    forward, backward = sides[0][:, 0] & sides[1][:, 1], sides[0][:, 1] & sides[1][:, 0]
    points: dict[tuple[int, int], IntArray] = {}
    for edge in np.flatnonzero(usable & (forward | backward)).tolist():
        rows = slice(*offsets[edge : edge + 2].tolist())
        matches, images = np.stack([keypoints1[rows], keypoints2[rows]], axis=1).astype(np.int64), ids[edge]
        if not forward[edge]:
            matches, images = matches[:, ::-1], images[::-1]
        ends = list(enumerate(images.tolist()))
        for side, image_id in ends:
            if (side, image_id) not in points:
                found = np.array([p.point3D_id for p in (own, other)[side].image(image_id).points2D], dtype=np.uint64)
                points[side, image_id] = np.where(found == NO_POINT, 0, found).astype(np.int64)
        seen = np.stack([points[end][m] for end, m in zip(ends, matches.T, strict=True)], axis=1)
        both = (seen > 0).all(axis=1)
        yield np.concatenate([seen[both], np.tile(images, (int(both.sum()), 1)), matches[both]], axis=1)


def _seen_points(
    model: "pycolmap.Reconstruction", point_ids: IntArray, image_ids: IntArray, keypoints: IntArray
) -> SeenPoints:
    unique, row = np.unique(image_ids, return_inverse=True)
    images = [model.image(i) for i in unique.tolist()]
    poses = [image.cam_from_world().rotation.matrix() for image in images]
    rays, focal = np.full((len(row), 3), np.nan), np.zeros(len(row))
    for k, image in enumerate(images):
        own, camera = np.flatnonzero(row == k), model.camera(image.camera_id)
        pixels = np.array([image.point2D(p).xy for p in keypoints[own].tolist()])
        found, valid = bearings_of_keypoints(camera, pixels)
        rays[own], focal[own] = np.where(valid[:, None], found, np.nan), focal_length(camera)
    return SeenPoints(
        np.array([model.point3D(i).xyz for i in point_ids.tolist()]),
        np.array(poses)[row],
        np.array([image.projection_center() for image in images])[row],
        rays,
        focal,
    )
