"""What the report shows of a model: cameras as frusta, a subset of the points, and histograms of all points."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.errors import DataFileError

Array = NDArray[np.float64]

MAX_POINTS = 50_000
"""Maximum number of points shown, of all models together."""
FAR_PERCENTILE, FAR_MARGIN = 2.0, 0.1
"""Points are shown in the box of the cameras and of all points between this percentile and its complement, enlarged by
this share of its sides."""
FRUSTUM_SHARE, MAX_FRUSTUM_SHARE = 0.4, 0.04
"""Depth of a frustum: share of the median distance between neighbouring cameras, and at most of the box's diagonal."""
NUM_BINS, MAX_TRACK = 40, 30


@dataclass(frozen=True, eq=False)
class ModelView:
    """A model as the report shows it, turned so that the images' upward direction is the third axis.

    Attributes
    ----------
    name : str
        Name of its folder.
    images : (k,) int64 array
        Rows of its images in the table of images.
    centers : (k, 3) array
        Projection centres.
    corners : (k, 4, 3) array
        Corners of the frusta's far ends.
    points : (m, 3) float32 array
        A subset of the points.
    colors : (m, 3) uint8 array
    num_points, num_far : int
        Number of all points, and of those too far from the scene to be shown.
    low, high : (3,) array
        Corners of the box of everything that is shown.
    error_edges, error_counts : array
        Histogram of the points' mean reprojection errors, pixels; the last bin holds all larger ones.
    track_counts : (MAX_TRACK + 1,) int64 array
        Number of points by track length; the last entry counts all longer ones.
    """

    name: str
    images: NDArray[np.int64]
    centers: Array
    corners: Array
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    num_points: int
    num_far: int
    low: Array
    high: Array
    error_edges: Array
    error_counts: NDArray[np.int64]
    track_counts: NDArray[np.int64]


def read_model(folder: Path) -> "pycolmap.Reconstruction":
    """Read a model in COLMAP's format.

    Raises
    ------
    DataFileError
        It is damaged.
    """
    try:
        model = pycolmap.Reconstruction(folder)
        model.update_point_3d_errors()
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise DataFileError(f"{folder}: the model cannot be read ({error}); run the job again") from error
    return model


def model_view(name: str, model: "pycolmap.Reconstruction", rows: Mapping[str, int], max_points: int) -> ModelView:
    """Make the view of a model.

    Parameters
    ----------
    name : str
    model : pycolmap.Reconstruction
    rows : mapping of str to int
        Row of each image in the table of images.
    max_points : int
        Maximum number of points to show.
    """
    shown = sorted((image for image in map(model.image, model.reg_image_ids()) if image.name in rows), key=_by_name)
    to_camera = np.array([image.cam_from_world().matrix() for image in shown]).reshape(-1, 3, 4)
    axes = to_camera[:, :, :3]
    turn = _upright(axes)
    centers = -np.einsum("nji,nj->ni", axes, to_camera[:, :, 3]) @ turn.T
    xyz, colors, errors, lengths = _points(model)
    xyz = xyz @ turn.T
    low, high = _box(xyz, centers)
    near = np.flatnonzero(((xyz >= low) & (xyz <= high)).all(axis=1))
    kept = near[np.linspace(0, len(near) - 1, max_points).astype(np.int64)] if len(near) > max_points else near
    depth = frustum_depth(centers, float(np.linalg.norm(high - low)))
    rays = np.array([_corner_rays(model.camera(image.camera_id)) for image in shown]).reshape(-1, 4, 3)
    corners = centers[:, None] + depth * np.einsum("nji,nkj->nki", axes, rays) @ turn.T
    limit = float(np.percentile(errors, 99)) if len(errors) else 1.0
    edges = np.linspace(0.0, max(limit, 1e-6), NUM_BINS + 1)
    return ModelView(
        name,
        np.array([rows[image.name] for image in shown], dtype=np.int64),
        centers,
        corners,
        xyz[kept].astype(np.float32),
        colors[kept],
        len(xyz),
        len(xyz) - len(near),
        np.minimum(low, corners.reshape(-1, 3).min(axis=0, initial=np.inf)),
        np.maximum(high, corners.reshape(-1, 3).max(axis=0, initial=-np.inf)),
        edges,
        np.histogram(np.minimum(errors, edges[-1]), edges)[0],
        np.bincount(np.minimum(lengths, MAX_TRACK), minlength=MAX_TRACK + 1),
    )


def _by_name(image: "pycolmap.Image") -> str:
    return str(image.name)


def _points(model: "pycolmap.Reconstruction") -> tuple[Array, NDArray[np.uint8], Array, NDArray[np.int64]]:
    """Positions, colours, errors and track lengths of all points, in the order of their ids."""
    points = [point for _, point in sorted(model.points3D.items())]
    return (
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        np.array([point.error for point in points], dtype=np.float64),
        np.array([point.track.length() for point in points], dtype=np.int64),
    )


def _upright(axes: Array) -> Array:
    """Rotation that turns the mean upward direction of the images to the third axis."""
    up = -axes[:, 1].sum(axis=0)
    if np.linalg.norm(up) < 1e-6 * max(len(axes), 1):
        return np.eye(3)
    up /= np.linalg.norm(up)
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def _box(xyz: Array, centers: Array) -> tuple[Array, Array]:
    """Corners of the box of the scene, without far points."""
    ends = [centers]
    if len(xyz):
        ends.append(np.percentile(xyz, [FAR_PERCENTILE, 100.0 - FAR_PERCENTILE], axis=0))
    both = np.concatenate(ends)
    if not len(both):
        return -np.ones(3), np.ones(3)
    low, high = both.min(axis=0), both.max(axis=0)
    margin = FAR_MARGIN * np.maximum(high - low, 0.1 * float((high - low).max()) + 1e-9)
    return low - margin, high + margin


def frustum_depth(centers: Array, diagonal: float) -> float:
    """Depth of the frusta of cameras (n, 3) in a scene with a diagonal."""
    if len(centers) < 2:
        return MAX_FRUSTUM_SHARE * diagonal
    from scipy.spatial import cKDTree

    neighbour = cKDTree(centers).query(centers, k=2)[0][:, 1]
    return float(np.clip(FRUSTUM_SHARE * np.median(neighbour), 0.005 * diagonal, MAX_FRUSTUM_SHARE * diagonal))


def _corner_rays(camera: "pycolmap.Camera") -> Array:
    """Rays through the corners of the image at depth 1, without distortion."""
    x, y = camera.width / 2, camera.height / 2
    focal = 0.5 * camera.width if camera.is_spherical() else camera.mean_focal_length()
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.column_stack([signs * [x / focal, y / focal], np.ones(4)])
