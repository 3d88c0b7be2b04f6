"""A reconstruction as the problem of bundle adjustment, and back."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.bundle.problem import BundleProblem, BundleState
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
    """

    def __init__(self, camera: "pycolmap.Camera", options: MappingOptions) -> None:
        self._camera = pycolmap.Camera(camera.todict())
        free = list(camera.focal_length_idxs()) if options.ba_refine_focal_length else []
        free += list(camera.principal_point_idxs()) if options.ba_refine_principal_point else []
        free += list(camera.extra_params_idxs()) if options.ba_refine_extra_params else []
        self.free: IntArray = np.array(free, dtype=np.int64)

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
        cls, reconstruction: "pycolmap.Reconstruction", options: MappingOptions, min_track_length: int
    ) -> "ModelProblem | None":
        """Collect the points with tracks of some length; None without any."""
        points = {
            point_id: point
            for point_id, point in sorted(reconstruction.points3D.items())
            if point.track.length() >= min_track_length
        }
        if not points:
            return None
        images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
        images.sort(key=lambda image: (image.camera_id, image.image_id))
        row_of = {point_id: row for row, point_id in enumerate(points)}
        image_row, point_row, keypoints = [], [], []
        for row, image in enumerate(images):
            for keypoint in image.get_observation_points2D():
                point = row_of.get(keypoint.point3D_id)
                if point is not None:
                    image_row.append(row)
                    point_row.append(point)
                    keypoints.append(keypoint.xy)
        camera_ids = sorted({image.camera_id for image in images})
        cameras = [reconstruction.camera(camera_id) for camera_id in camera_ids]
        problem = BundleProblem(
            image_row=np.array(image_row, dtype=np.int64),
            point_row=np.array(point_row, dtype=np.int64),
            keypoints=np.array(keypoints),
            camera_idx=np.searchsorted(camera_ids, [image.camera_id for image in images]),
            lenses=[ColmapLens(camera, options) for camera in cameras],
        )
        state = BundleState(
            rotations=np.array([image.cam_from_world().rotation.matrix() for image in images]),
            centers=np.array([image.projection_center() for image in images]),
            points=np.array([point.xyz for point in points.values()]),
            parameters=[np.array(camera.params, dtype=np.float64) for camera in cameras],
        )
        return cls(problem, state, [image.image_id for image in images], camera_ids, list(points))

    def write(self, state: BundleState, reconstruction: "pycolmap.Reconstruction") -> None:
        """Give the reconstruction the poses, lenses and points of a state."""
        for camera_id, parameters in zip(self.camera_ids, state.parameters, strict=True):
            reconstruction.camera(camera_id).params = parameters.tolist()
        for image_id, R, center in zip(self.image_ids, state.rotations, state.centers, strict=True):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center)
            reconstruction.frame(reconstruction.image(image_id).frame_id).rig_from_world = pose
        for point_id, position in zip(self.point_ids, state.points, strict=True):
            reconstruction.point3D(point_id).xyz = position


def has_rigs(reconstruction: "pycolmap.Reconstruction") -> bool:
    """Whether some rig has several sensors."""
    return any(rig.num_sensors() > 1 for rig in reconstruction.rigs.values())
