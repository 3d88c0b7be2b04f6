"""A reconstruction as the problem of bundle adjustment, and back."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.options import MappingOptions

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


class ColmapLens:
    """A COLMAP camera with unknown parameters.

    Parameters
    ----------
    camera : pycolmap.Camera
        It is copied.
    options : MappingOptions
        Which parameters are refined.
    held : bool
        Whether none is.
    """

    def __init__(self, camera: "pycolmap.Camera", options: MappingOptions, *, held: bool = False) -> None:
        self._camera = pycolmap.Camera(camera.todict())
        free = list(camera.focal_length_idxs()) if options.ba_refine_focal_length else []
        free += list(camera.principal_point_idxs()) if options.ba_refine_principal_point else []
        free += list(camera.extra_params_idxs()) if options.ba_refine_extra_params else []
        self.free: IntArray = np.array([] if held else free, dtype=np.int64)
        self.focal = np.isin(self.free, list(camera.focal_length_idxs()))

    def project(self, parameters: Array, rays: Array) -> Array:
        """Project rays (k, 3) of the camera's frame: pixels (k, 2), NaN where a ray has no projection."""
        self._camera.params = parameters.tolist()
        return np.asarray(self._camera.img_from_cam(rays), dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class ModelProblem:
    """The bundle adjustment of a reconstruction whose frames are single images.

    Attributes
    ----------
    problem : BundleProblem
    state : BundleState
        Of the reconstruction.
    image_ids, camera_ids, point_ids : list of int
        In the order of the problem.
    """

    problem: BundleProblem
    state: BundleState
    image_ids: list[int]
    camera_ids: list[int]
    point_ids: list[int]

    @classmethod
    def of(
        cls,
        reconstruction: "pycolmap.Reconstruction",
        seen: ModelObservations,
        options: MappingOptions,
        min_track_length: int,
        held_frames: frozenset[int] = frozenset(),
    ) -> "ModelProblem | None":
        """Collect what is adjusted, and what it depends on.

        Parameters
        ----------
        reconstruction : pycolmap.Reconstruction
            Without rigs of several sensors.
        seen : ModelObservations
            Of the reconstruction.
        options : MappingOptions
        min_track_length : int
            Points with fewer observations are left out.
        held_frames : frozenset of int
            Ids of frames that keep their poses and lenses, and the points that they see in more than half of their
            observations.

        Returns
        -------
        ModelProblem or None
            None without points.
        """
        images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
        images.sort(key=lambda image: (image.camera_id, image.image_id))
        held = np.array([image.frame_id in held_frames for image in images], dtype=bool)
        image_row = _rows_of([image.image_id for image in images], seen.image_ids)
        every, point_row, length = np.unique(seen.point_ids, return_inverse=True, return_counts=True)
        views = np.bincount(point_row, ~held[image_row], len(every))
        fixed = 2.0 * views < length
        kept = (length >= min_track_length) & (views > 0.0)
        if not kept.any():
            return None
        used = np.flatnonzero(kept[point_row] & ~(held[image_row] & fixed[point_row]))
        used = used[np.argsort(image_row[used], kind="stable")]
        camera_ids = sorted({image.camera_id for image in images})
        cameras = [reconstruction.camera(camera_id) for camera_id in camera_ids]
        of_held = {image.camera_id for image, stays in zip(images, held, strict=True) if stays}
        problem = BundleProblem(
            image_row=image_row[used],
            point_row=(np.cumsum(kept) - 1)[point_row[used]],
            keypoints=seen.keypoints[used],
            camera_idx=np.searchsorted(camera_ids, [image.camera_id for image in images]),
            lenses=[
                ColmapLens(camera, options, held=camera_id in of_held)
                for camera_id, camera in zip(camera_ids, cameras, strict=True)
            ],
            held=held if held_frames else None,
            fixed=fixed[kept] if held_frames else None,
        )
        state = BundleState(
            rotations=np.array([image.cam_from_world().rotation.matrix() for image in images]),
            centers=np.array([image.projection_center() for image in images]),
            points=seen.positions_of(every[kept]),
            parameters=[np.array(camera.params, dtype=np.float64) for camera in cameras],
        )
        return cls(problem, state, [image.image_id for image in images], camera_ids, every[kept].tolist())

    def write(self, state: BundleState, reconstruction: "pycolmap.Reconstruction") -> None:
        """Give the reconstruction the poses, lenses and points of a state."""
        for camera_id, parameters in zip(self.camera_ids, state.parameters, strict=True):
            reconstruction.camera(camera_id).params = parameters.tolist()
        for image_id, R, center in zip(self.image_ids, state.rotations, state.centers, strict=True):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center)
            reconstruction.frame(reconstruction.image(image_id).frame_id).rig_from_world = pose
        moved = np.ones(len(state.points), dtype=bool) if self.problem.fixed is None else ~self.problem.fixed
        for row in np.flatnonzero(moved).tolist():
            reconstruction.point3D(self.point_ids[row]).xyz = state.points[row]


def _rows_of(ids: list[int], wanted: IntArray) -> IntArray:
    """Place of each wanted id among distinct ids."""
    order = np.argsort(ids)
    return np.asarray(order[np.searchsorted(np.array(ids)[order], wanted)])


def has_rigs(reconstruction: "pycolmap.Reconstruction") -> bool:
    """Whether some rig has several sensors."""
    return any(rig.num_sensors() > 1 for rig in reconstruction.rigs.values())
