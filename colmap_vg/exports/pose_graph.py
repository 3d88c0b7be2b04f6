"""Pose graphs in g2o's text format: a vertex per image, an edge per pair of images.

A vertex is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, camera to world; its id is the image's in the model. An edge is
``EDGE_SE3:QUAT i j x y z qx qy qz qw``, camera j in the frame of camera i, and the upper triangle of its information
matrix.

Jobs keep no relative poses. So the edges hold those of the finished model, and their information is the identity times
the number of matches or points that support the pair: edges say what is linked and how firmly, not what was measured.
"""

import json
from pathlib import Path

import numpy as np
from scipy import sparse

from colmap_vg.exports.source import Source, world_from_cam
from colmap_vg.jobs.verdict_tables import PAIRS_NAME, read_tables
from colmap_vg.scene.verdicts import USED_EDGES

MIN_SHARED_POINTS = 15
"""Points that two images share at least if the model alone tells the pairs: COLMAP's minimum of inlier matches."""


def write_g2o(source: Source, path: Path) -> list[str]:
    """Write the pose graph.

    Returns
    -------
    list of str
        A note on what the edges are.

    Raises
    ------
    DataFileError
        The job's table of pairs is damaged.
    """
    images = source.images()
    pairs, note = linked_pairs(source)
    lines = [f"# {image.image_id} {json.dumps(image.name)}" for image in images]
    for image in images:
        quaternion, center = world_from_cam(image)
        lines.append(f"VERTEX_SE3:QUAT {image.image_id} {_row([*center, *quaternion])}")
    poses = {image.image_id: image.cam_from_world() for image in images}
    rows, columns = np.triu_indices(6)
    for (i, j), count in sorted(pairs.items()):
        pose = poses[i] * poses[j].inverse()
        information = np.where(rows == columns, float(count), 0.0)
        values = _row([*pose.translation, *pose.rotation.quat, *information])
        lines.append(f"EDGE_SE3:QUAT {i} {j} {values}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return [f"{len(pairs)} edges: {note}, with the model's own relative poses"]


def linked_pairs(source: Source) -> tuple[dict[tuple[int, int], int], str]:
    """Return the pairs of images and how many matches or points support each, and in words what they are.

    Returns
    -------
    pairs : dict of (int, int) to int
        Image ids, the smaller one first.
    note : str
    """
    images = source.images()
    ids = {image.name: image.image_id for image in images}
    if source.job is not None and (source.job / PAIRS_NAME).exists():
        used = [pair for pair in read_tables(source.job).pairs if pair.verdict in USED_EDGES]
        ends = [(ids.get(pair.image1), ids.get(pair.image2), pair.num_inliers) for pair in used]
        pairs = {(min(i, j), max(i, j)): int(count or 1) for i, j, count in ends if i is not None and j is not None}
        return pairs, "pairs that the job used, weighted by their inlier matches"
    shared = _shared_points(source)
    return shared, f"pairs that share {MIN_SHARED_POINTS} points or more, weighted by their number"


def _shared_points(source: Source) -> dict[tuple[int, int], int]:
    tracks = [
        sorted({element.image_id for element in point.track.elements})
        for point in source.reconstruction.points3D.values()
    ]
    column = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    row = np.array([image_id for track in tracks for image_id in track], dtype=np.int64)
    ids, row = np.unique(row, return_inverse=True)
    seen = sparse.csr_array((np.ones(len(row)), (row, column)), shape=(len(ids), len(tracks)))
    counts = sparse.triu(seen @ seen.T, k=1).tocoo()
    return {
        (int(ids[i]), int(ids[j])): int(count)
        for i, j, count in zip(counts.row, counts.col, counts.data, strict=True)
        if count >= MIN_SHARED_POINTS
    }


def _row(values: object) -> str:
    return " ".join(repr(value) for value in np.asarray(values, dtype=np.float64).tolist())
