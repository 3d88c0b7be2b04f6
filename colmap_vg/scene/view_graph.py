"""The viewing graph: images as nodes, verified pairs as edges with relative poses.

World to camera is ``x_cam = R x_world + t`` (COLMAP's ``cam_from_world``). Correspondence with the paper's notation:

===================================================  ==========================================================
paper (Nasiri et al.)                                here
===================================================  ==========================================================
``R_i``, camera to world                             ``cam_from_world_rotations[i].T``
``p_i``                                              ``projection_centers[i]``
``R_ij = R_j^T R_i``                                 ``cam2_from_cam1_rotations[k]`` for ``edges[k] = (i, j)``
``gamma^l_ij = R_i^T (p_j - p_i) / ||p_j - p_i||``   ``cam2_in_cam1_directions[k]``, camera 2's centre from camera 1
===================================================  ==========================================================

With ``cam2_from_cam1 = (R_21, t_21)`` the direction is ``-R_21^T t_21 / ||t_21||``. Image *ids* are the database's;
image *rows* (`edges`, `camera_idx`) are positions in `image_ids`.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.scene.pose_priors import PosePriors
from colmap_vg.scene.rigs import Rigs
from colmap_vg.scene.verdicts import USED_EDGES, EdgeVerdict

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """All images and verified pairs of a scene, including unusable ones. Arrays are read-only by convention.

    Attributes
    ----------
    image_ids : (n,) int64 array
        Unique image ids of the database.
    edges : (m, 2) int64 array
        Rows into `image_ids`, two different ones per edge.
    cam2_from_cam1_rotations : (m, 3, 3) array
        Relative rotations.
    cam2_in_cam1_directions : (m, 3) array
        Unit vectors from camera 1 towards camera 2, in camera 1's frame.
    num_inliers : (m,) int64 array or None
        Number of verified matches of each edge.
    camera_idx : (n,) int64 array or None
        Row of each image's camera in the per-camera arrays.
    image_names : tuple of str
        Names in the order of `image_ids`; empty when unknown.
    priors : PosePriors or None
        Measured positions and gravity of the images.
    rigs : Rigs or None
        Frames and sensors of the images; None where no rig has two cameras.
    camera_ids : (c,) int64 array or None
        Camera ids of the database.
    camera_focal_lengths : (c,) array or None
        Mean focal length, pixels, with which bearings and relative poses were computed.
    camera_focal_known : (c,) bool array or None
        Whether that focal length was given (calibrated, or from EXIF and not contradicted) rather than estimated.
    camera_radial : (c,) bool array or None
        Whether the camera's model has a radial term that may be estimated with its focal length.
    read_verdicts : (m,) str array or None
        `EdgeVerdict` words from reading; edges other than ``kept`` and ``rotation_only`` are not used by the solver.
    trusted : (m,) bool array or None
        Edges that no filter may drop, as specified by the user.
    found_radial_terms : (c,) array or None
        Estimated radial terms, at the database's focal lengths, of cameras without distortion in the database. Bearings
        are computed with them.
    verified_anew : (m,) bool array or None
        Pairs that were verified again, since matches and configuration in the database were inconsistent.
    planar : (m,) bool array or None
        Pairs explained by a homography, whose relative pose is less certain.
    triangulation_angles : (m,) array or None
        Median angle between the rays of an edge's inliers, radians.
    edge_information : (m, 5, 5) array or None
        Inverse covariance of each relative pose, radians: rotation in camera 2's frame (3), direction in its tangent
        plane ``tangent_basis(direction)`` (2).
    inlier_offsets : (m + 1,) int64 array or None
        Inliers of edge k are rows ``inlier_offsets[k]:inlier_offsets[k + 1]`` of the arrays below.
    inlier_bearings1, inlier_bearings2 : (k, 3) array or None
        Unit rays of the matched keypoints in camera 1's and camera 2's frame.
    inlier_keypoints1, inlier_keypoints2 : (k,) int32 array or None
        Keypoint indices in image 1 and image 2.
    """

    image_ids: IntArray
    edges: IntArray
    cam2_from_cam1_rotations: Array
    cam2_in_cam1_directions: Array
    num_inliers: IntArray | None = None
    camera_idx: IntArray | None = None
    image_names: tuple[str, ...] = field(default=(), kw_only=True)
    priors: PosePriors | None = field(default=None, kw_only=True)
    rigs: Rigs | None = field(default=None, kw_only=True)
    camera_ids: IntArray | None = field(default=None, kw_only=True)
    camera_focal_lengths: Array | None = field(default=None, kw_only=True)
    camera_focal_known: BoolArray | None = field(default=None, kw_only=True)
    camera_radial: BoolArray | None = field(default=None, kw_only=True)
    read_verdicts: NDArray[np.str_] | None = field(default=None, kw_only=True)
    trusted: BoolArray | None = field(default=None, kw_only=True)
    found_radial_terms: Array | None = field(default=None, kw_only=True)
    verified_anew: BoolArray | None = field(default=None, kw_only=True)
    planar: BoolArray | None = field(default=None, kw_only=True)
    triangulation_angles: Array | None = field(default=None, kw_only=True)
    edge_information: Array | None = field(default=None, kw_only=True)
    inlier_offsets: IntArray | None = field(default=None, kw_only=True)
    inlier_bearings1: Array | None = field(default=None, kw_only=True)
    inlier_bearings2: Array | None = field(default=None, kw_only=True)
    inlier_keypoints1: NDArray[np.int32] | None = field(default=None, kw_only=True)
    inlier_keypoints2: NDArray[np.int32] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name, kind in _KINDS.items():
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _array(name, value, kind))
            elif name in _REQUIRED:
                raise GraphError(f"ViewGraph.{name} is missing")
        for names in _TOGETHER:
            absent = [name for name in names if getattr(self, name) is None]
            if absent and len(absent) < len(names):
                raise GraphError(f"ViewGraph.{absent[0]} is missing; {', '.join(names)} go together")
        self._check_shapes()
        self._check_values()

    @property
    def num_images(self) -> int:
        """Number of images n."""
        return len(self.image_ids)

    @property
    def num_edges(self) -> int:
        """Number of edges m."""
        return len(self.edges)

    @property
    def has_rotation(self) -> BoolArray:
        """Mask (m,) of the edges whose rotation may be used."""
        if self.read_verdicts is None:
            return np.ones(self.num_edges, dtype=bool)
        return np.isin(self.read_verdicts, USED_EDGES)

    @property
    def has_direction(self) -> BoolArray:
        """Mask (m,) of the edges whose rotation and direction may be used."""
        if self.read_verdicts is None:
            return np.ones(self.num_edges, dtype=bool)
        return np.asarray(self.read_verdicts == EdgeVerdict.KEPT)

    @property
    def has_inliers(self) -> bool:
        """Whether the graph contains the bearings of the matches."""
        return self.inlier_offsets is not None and self.inlier_bearings1 is not None and len(self.inlier_bearings1) > 0

    def _check_shapes(self) -> None:
        n, m = len(self.image_ids), len(self.edges)
        k = 0 if self.inlier_bearings1 is None else len(self.inlier_bearings1)
        c = None if self.camera_focal_lengths is None else len(self.camera_focal_lengths)
        expected: dict[str, tuple[int | None, ...]] = {
            "image_ids": (n,),
            "edges": (m, 2),
            "cam2_from_cam1_rotations": (m, 3, 3),
            "cam2_in_cam1_directions": (m, 3),
            "num_inliers": (m,),
            "camera_idx": (n,),
            "camera_ids": (c,),
            "camera_focal_lengths": (c,),
            "camera_focal_known": (c,),
            "camera_radial": (c,),
            "read_verdicts": (m,),
            "trusted": (m,),
            "planar": (m,),
            "verified_anew": (m,),
            "found_radial_terms": (c,),
            "triangulation_angles": (m,),
            "edge_information": (m, 5, 5),
            "inlier_offsets": (m + 1,),
            "inlier_bearings1": (k, 3),
            "inlier_bearings2": (k, 3),
            "inlier_keypoints1": (k,),
            "inlier_keypoints2": (k,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.ndim != len(shape) or any(w not in (None, h) for h, w in zip(value.shape, shape, strict=True)):
                raise GraphError(
                    f"ViewGraph.{name} has shape {value.shape}, expected {shape} (n={n} images, m={m} edges)"
                )
        if self.image_names and len(self.image_names) != n:
            raise GraphError(f"ViewGraph.image_names has {len(self.image_names)} names for {n} images")
        if self.priors is not None and len(self.priors.positions) != n:
            raise GraphError(f"ViewGraph.priors are of {len(self.priors.positions)} images, expected {n}")
        if self.rigs is not None and len(self.rigs.frame_idx) != n:
            raise GraphError(f"ViewGraph.rigs are of {len(self.rigs.frame_idx)} images, expected {n}")

    def _check_values(self) -> None:
        n, edges, R, g = self.num_images, self.edges, self.cam2_from_cam1_rotations, self.cam2_in_cam1_directions
        if len(np.unique(self.image_ids)) != n:
            raise GraphError("ViewGraph.image_ids are not unique")
        if len(edges) and (edges.min() < 0 or edges.max() >= n):
            raise GraphError(f"ViewGraph.edges has rows {edges.min()} to {edges.max()}, outside the {n} images")
        loops = np.flatnonzero(edges[:, 0] == edges[:, 1])
        if len(loops):
            raise GraphError(f"ViewGraph.edges: edge {loops[0]} links image row {edges[loops[0], 0]} to itself")
        _refuse("cam2_from_cam1_rotations", np.asarray(~np.isfinite(R).all(axis=(1, 2))), "has NaN or infinite values")
        _refuse("cam2_in_cam1_directions", np.asarray(~np.isfinite(g).all(axis=1)), "has NaN or infinite values")
        skewed = np.asarray(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0) > 1e-6)
        _refuse("cam2_from_cam1_rotations", np.asarray(skewed | (np.linalg.det(R) < 0)), "is not a rotation matrix")
        _refuse(
            "cam2_in_cam1_directions",
            np.asarray(np.abs(np.linalg.norm(g, axis=1) - 1.0) > 1e-6),
            "is not a unit vector",
        )
        if self.inlier_offsets is not None:
            o, k = self.inlier_offsets, 0 if self.inlier_bearings1 is None else len(self.inlier_bearings1)
            if o[0] != 0 or o[-1] != k or (np.diff(o) < 0).any():
                raise GraphError(f"ViewGraph.inlier_offsets must increase from 0 to the number of inliers {k}")
        if self.camera_idx is not None and len(self.camera_idx):
            last = self.camera_idx.max() if self.camera_focal_lengths is None else len(self.camera_focal_lengths) - 1
            if self.camera_idx.min() < 0 or self.camera_idx.max() > min(last, _MAX_ROW):
                raise GraphError(f"ViewGraph.camera_idx has rows without a camera, up to {self.camera_idx.max()}")
        if self.num_inliers is not None:
            _refuse("num_inliers", np.asarray(self.num_inliers < 0), "is negative")
        if self.camera_focal_lengths is not None:
            f = self.camera_focal_lengths
            _refuse("camera_focal_lengths", np.asarray(~((f > 0) & (f < np.inf))), "is not a focal length in pixels")
        if self.edge_information is not None:
            _refuse("edge_information", _invalid_information(self.edge_information), "is not an information matrix")
        for name in ("inlier_bearings1", "inlier_bearings2"):
            rays = getattr(self, name)
            if rays is not None:
                squared = np.einsum("ka,ka->k", rays, rays)
                _refuse(name, np.asarray(~(np.abs(squared - 1.0) < 2e-6)), "is not a unit vector")


_REQUIRED = ("image_ids", "edges", "cam2_from_cam1_rotations", "cam2_in_cam1_directions")
_TOGETHER = (
    ("inlier_offsets", "inlier_bearings1", "inlier_bearings2"),
    ("inlier_keypoints1", "inlier_keypoints2"),
    ("camera_ids", "camera_focal_lengths"),
)
_MAX_ROW = 2**31
"""Upper limit of camera rows, since arrays of that length would be allocated for a larger, mistaken one."""


_KINDS: dict[str, type] = {
    "image_ids": np.int64,
    "edges": np.int64,
    "cam2_from_cam1_rotations": np.float64,
    "cam2_in_cam1_directions": np.float64,
    "num_inliers": np.int64,
    "camera_idx": np.int64,
    "camera_ids": np.int64,
    "camera_focal_lengths": np.float64,
    "camera_focal_known": np.bool_,
    "camera_radial": np.bool_,
    "read_verdicts": np.str_,
    "trusted": np.bool_,
    "planar": np.bool_,
    "verified_anew": np.bool_,
    "found_radial_terms": np.float64,
    "triangulation_angles": np.float64,
    "edge_information": np.float64,
    "inlier_offsets": np.int64,
    "inlier_bearings1": np.float64,
    "inlier_bearings2": np.float64,
    "inlier_keypoints1": np.int32,
    "inlier_keypoints2": np.int32,
}


def _array(name: str, value: object, kind: type) -> NDArray[np.generic]:
    try:
        found = np.asarray(value)
    except ValueError as error:
        raise GraphError(f"ViewGraph.{name} is not an array: {error}") from error
    if found.ndim == 0:
        raise GraphError(f"ViewGraph.{name} must be an array, found {found}")
    if name in ("edges", "cam2_from_cam1_rotations", "cam2_in_cam1_directions") and found.size == 0:
        found = found.reshape(0, *{"edges": (2,), "cam2_from_cam1_rotations": (3, 3)}.get(name, (3,)))
    allowed, what = _ALLOWED[np.dtype(kind).kind]
    if found.size and found.dtype.kind not in allowed:
        raise GraphError(f"ViewGraph.{name} must have {what}, found {found.dtype}")
    if (
        np.dtype(kind).kind == "i"
        and found.size
        and (found.max() > np.iinfo(kind).max or found.min() < np.iinfo(kind).min)
    ):
        raise GraphError(
            f"ViewGraph.{name} has values from {found.min()} to {found.max()}, too large for {kind.__name__}"
        )
    return np.asarray(found, dtype=kind)


_ALLOWED = {"i": ("iu", "integers"), "f": ("iuf", "real numbers"), "b": ("b", "True or False"), "U": ("UO", "words")}


def _invalid_information(matrices: Array) -> BoolArray:
    """Mask (m,) of matrices (m, 5, 5) that are not finite, have a negative diagonal entry, or are not symmetric."""
    with np.errstate(invalid="ignore"):
        size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
        skew = np.abs(matrices - np.swapaxes(matrices, 1, 2)).max(axis=(1, 2), initial=0.0)
        negative = (np.diagonal(matrices, axis1=1, axis2=2) < 0).any(axis=1)
        return np.asarray(~np.isfinite(size) | negative | (skew > 1e-6 * size))


def _refuse(name: str, bad: BoolArray, what: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise GraphError(f"ViewGraph.{name}: row {rows[0]} {what} ({len(rows)} such rows)")
