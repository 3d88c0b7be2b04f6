"""Snapshot of a reconstruction before bundle adjustment, to go back to where its lenses run away.

Where coefficients of a lens trade off against each other, as the two of EUCM do in narrow views, steps can leave the
range in which the lens projects points at all. COLMAP drops the residuals of such points, so the cost falls to zero.
"""

from dataclasses import dataclass
from typing import Self

import pycolmap

from colmap_vg.mapping.observations import num_projected

TRADING_OFF = ("EUCM", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
"""Camera models with several coefficients of similar effect."""
MIN_SHARE_LEFT = 0.5
"""Minimum share of the projected observations that still have a projection after an adjustment."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of a reconstruction, and how many of its sampled observations have a projection."""

    copy: "pycolmap.Reconstruction"
    num_projected: int

    @classmethod
    def of(cls, reconstruction: "pycolmap.Reconstruction") -> Self | None:
        """Take a snapshot; None where no camera has coefficients that trade off."""
        if not any(camera.model_name in TRADING_OFF for camera in reconstruction.cameras.values()):
            return None
        return cls(pycolmap.Reconstruction(reconstruction), num_projected(reconstruction))

    def is_spoilt(self, reconstruction: "pycolmap.Reconstruction") -> bool:
        """Whether most observations lost their projection."""
        return num_projected(reconstruction) < MIN_SHARE_LEFT * self.num_projected

    def restore(self, reconstruction: "pycolmap.Reconstruction") -> None:
        """Give the reconstruction the cameras, poses and points of the snapshot."""
        for camera_id, camera in self.copy.cameras.items():
            reconstruction.camera(camera_id).params = camera.params.tolist()
        for rig_id, rig in self.copy.rigs.items():
            for sensor in rig.non_ref_sensors:
                pose = rig.sensor_from_rig(sensor)
                if pose is not None:
                    reconstruction.rig(rig_id).set_sensor_from_rig(sensor, pose)
        for frame_id in self.copy.reg_frame_ids():
            reconstruction.frame(frame_id).rig_from_world = self.copy.frame(frame_id).rig_from_world
        for point_id, point in self.copy.points3D.items():
            reconstruction.point3D(point_id).xyz = point.xyz
