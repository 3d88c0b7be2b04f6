"""Matches of a pair, sorted by what became of them, and a picture of both photographs with them."""

import sqlite3
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import reading
from colmap_vg.colmap_io.tables import MAX_NUM_IMAGES
from colmap_vg.geometry.directions import normalized
from colmap_vg.reading.verification import MAX_ERROR_PX
from colmap_vg.report.thumbnails import photograph
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors
from colmap_vg.viewer.finished_job import FinishedJob

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Picture = NDArray[np.uint8]

MAX_SHOWN, HEIGHT, MAX_WIDTH, GAP = 200, 360, 640, 8
"""Maximum number of matches drawn of each kind; height and maximum width of a photograph, and the gap, pixels."""


class MatchKind(StrEnum):
    """What became of a match."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNSOLVED = "unsolved"
    REJECTED = "rejected"


COLORS: dict[MatchKind, tuple[int, int, int]] = {
    MatchKind.REJECTED: (220, 60, 60),
    MatchKind.UNSOLVED: (120, 120, 235),
    MatchKind.CONTRADICTS: (245, 150, 40),
    MatchKind.AGREES: (50, 190, 90),
}
"""Red, green and blue of the lines, in the order in which they are drawn."""
TOLD = {
    MatchKind.AGREES: "green: verified, and within 4 px of the solution",
    MatchKind.CONTRADICTS: "orange: verified, but contradict the solution",
    MatchKind.UNSOLVED: "blue: verified, but the images are not in one model",
    MatchKind.REJECTED: "red: rejected by two-view verification",
}


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches of a pair.

    Attributes
    ----------
    points1, points2 : (k, 2) array
        Keypoints in the first and the second image of the pair, pixels.
    kinds : (k,) str array
        `MatchKind` words.
    """

    points1: Array
    points2: Array
    kinds: NDArray[np.str_]

    def told(self) -> str:
        """Number of matches of each kind."""
        counts = {kind: int((self.kinds == kind).sum()) for kind in TOLD}
        return "; ".join(f"{count} {TOLD[kind]}" for kind, count in counts.items() if count) or "no matches"


def pair_matches(job: FinishedJob, solution: PoseSolution, pair: int) -> PairMatches:
    """Read a pair's matches before and after verification, and compare the verified ones with a solution.

    Parameters
    ----------
    job : FinishedJob
    solution : PoseSolution
    pair : int
        Row of the graph's edge.

    Raises
    ------
    DatabaseError
        The database cannot be read.
    """
    i, j = job.graph.edges[pair].tolist()
    ids = int(job.graph.image_ids[i]), int(job.graph.image_ids[j])
    verified, kinds = _verified(job, solution, pair)
    with reading(job.database_path) as connection:
        points1, points2 = (_keypoints(connection, image_id) for image_id in ids)
        raw = _raw_matches(connection, *ids)
    done = set(map(tuple, verified.tolist()))
    rejected = np.array([row for row in raw.tolist() if tuple(row) not in done], dtype=np.int64).reshape(-1, 2)
    matches = np.concatenate([rejected, verified])
    words = np.concatenate([np.full(len(rejected), str(MatchKind.REJECTED)), kinds])
    inside = (matches[:, 0] < len(points1)) & (matches[:, 1] < len(points2))
    return PairMatches(points1[matches[inside, 0]], points2[matches[inside, 1]], words[inside])


def _verified(job: FinishedJob, solution: PoseSolution, pair: int) -> tuple[IntArray, NDArray[np.str_]]:
    """Keypoint rows (k, 2) of a pair's verified matches, and their kinds (k,)."""
    graph = job.graph
    offsets, rows1, rows2 = graph.inlier_offsets, graph.inlier_keypoints1, graph.inlier_keypoints2
    rays1, rays2 = graph.inlier_bearings1, graph.inlier_bearings2
    if offsets is None or rows1 is None or rows2 is None or rays1 is None or rays2 is None:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=str)
    rows = slice(int(offsets[pair]), int(offsets[pair + 1]))
    matches = np.stack([rows1[rows], rows2[rows]], axis=1).astype(np.int64)
    i, j = graph.edges[pair].tolist()
    if solution.component[i] < 0 or solution.component[i] != solution.component[j]:
        return matches, np.full(len(matches), str(MatchKind.UNSOLVED))
    R, centers = solution.cam_from_world_rotations, solution.projection_centers
    direction = normalized((R[i] @ (centers[j] - centers[i]))[None])
    focals = np.ones(2)
    if graph.camera_focal_lengths is not None and graph.camera_idx is not None:
        focals = (graph.camera_focal_lengths * solution.focal_scales)[graph.camera_idx[[i, j]]]
    errors = sampson_errors(
        essential_from_pose((R[j] @ R[i].T)[None], direction),
        np.array([0, len(matches)]),
        rays1[rows],
        rays2[rows],
        focals[:1],
        focals[1:],
    )
    agree = np.abs(errors) <= MAX_ERROR_PX
    return matches, np.where(agree, str(MatchKind.AGREES), str(MatchKind.CONTRADICTS))


def _keypoints(connection: sqlite3.Connection, image_id: int) -> Array:
    found = connection.execute(
        "SELECT rows, cols, data FROM keypoints WHERE image_id = ? AND typeof(data) = 'blob'", (image_id,)
    ).fetchone()
    if found is None or found[1] < 2 or found[0] * found[1] * 4 != len(found[2]):
        return np.zeros((0, 2))
    return np.frombuffer(found[2], dtype=np.float32).reshape(found[0], found[1])[:, :2].astype(np.float64)


def _raw_matches(connection: sqlite3.Connection, id1: int, id2: int) -> IntArray:
    """Keypoint rows (k, 2) of a pair's matches before verification; none if the database lacks them."""
    found = connection.execute(
        "SELECT rows, data FROM matches WHERE pair_id = ? AND cols = 2 AND typeof(data) = 'blob'",
        (min(id1, id2) * MAX_NUM_IMAGES + max(id1, id2),),
    ).fetchone()
    if found is None or found[0] * 8 != len(found[1]):
        return np.zeros((0, 2), dtype=np.int64)
    matches = np.frombuffer(found[1], dtype=np.uint32).reshape(-1, 2).astype(np.int64)
    return matches if id1 < id2 else matches[:, ::-1]


def picture(job: FinishedJob, pair: int, matches: PairMatches) -> Picture:
    """Draw both photographs of a pair side by side, with its matches as lines.

    Parameters
    ----------
    job : FinishedJob
        A photograph that is missing, unreadable or outside of the job's folder of photographs is left grey.
    pair : int
    matches : PairMatches

    Returns
    -------
    (h, w, 3) uint8 array
        Red, green and blue.
    """
    halves, scales = [], []
    for image in job.graph.edges[pair].tolist():
        width, height = job.sizes[image].tolist()
        scale = min(HEIGHT / height, MAX_WIDTH / width)
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        name = job.graph.image_names[image]
        pixels = None if job.image_path is None else photograph(job.image_path, name, max(size))
        halves.append(np.full((size[1], size[0], 3), 110, np.uint8) if pixels is None else cv2.resize(pixels, size))
        scales.append(scale)
    left = halves[0].shape[1] + GAP
    canvas = np.full((max(half.shape[0] for half in halves), left + halves[1].shape[1], 3), 255, np.uint8)
    for half, start in zip(halves, (0, left), strict=True):
        canvas[: half.shape[0], start : start + half.shape[1]] = half[:, :, :3]
    for kind, color in COLORS.items():
        rows = np.flatnonzero(matches.kinds == kind)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_SHOWN)).astype(np.int64))]
        ends1 = np.rint(matches.points1[rows] * scales[0]).astype(int)
        ends2 = np.rint(matches.points2[rows] * scales[1] + [left, 0]).astype(int)
        for one, other in zip(ends1.tolist(), ends2.tolist(), strict=True):
            cv2.line(canvas, one, other, color, 1, cv2.LINE_AA)
            for end in (one, other):
                cv2.circle(canvas, end, 2, color, -1, cv2.LINE_AA)
    return canvas
