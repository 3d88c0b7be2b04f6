"""Rigs: cameras that are mounted together, and the frames in which they take photographs at once."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rigs:
    """Rigs of n images: a frame and a sensor for each of them. Every camera is a sensor of one rig.

    An image's pose is ``cam_from_world = sensor_from_rig * rig_from_world`` of its sensor and its frame.

    Attributes
    ----------
    frame_idx : (n,) int64 array
        Row of each image's frame.
    sensor_idx : (n,) int64 array
        Row of each image's sensor.
    frame_ids : (f,) int64 array
        Of the database.
    rig_ids : (s,) int64 array
        Rig of each sensor, of the database.
    camera_ids : (s,) int64 array
        Camera of each sensor, of the database.
    rotations : (s, 3, 3) array
        sensor_from_rig rotations; NaN where the pose is not known.
    translations : (s, 3) array
        sensor_from_rig translations, in the unit of whoever calibrated the rig; NaN where the pose is not known.
    reference : (s,) bool array
        Sensors whose frame is the rig's.
    separated : (s,) bool array or None
        Sensors that the database has in a rig, and that are rigs of their own here, see :meth:`separate`.
    """

    frame_idx: IntArray
    sensor_idx: IntArray
    frame_ids: IntArray
    rig_ids: IntArray
    camera_ids: IntArray
    rotations: Array
    translations: Array
    reference: BoolArray
    separated: BoolArray | None = None

    def __post_init__(self) -> None:
        n, s = len(self.frame_idx), len(self.camera_ids)
        shapes = {
            "sensor_idx": (n,),
            "rig_ids": (s,),
            "rotations": (s, 3, 3),
            "translations": (s, 3),
            "reference": (s,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise GraphError(f"Rigs.{name} has shape {getattr(self, name).shape}, expected {shape}")
        for name, count in {"frame_idx": len(self.frame_ids), "sensor_idx": s}.items():
            rows = getattr(self, name)
            if n and not 0 <= rows.min() <= rows.max() < count:
                raise GraphError(f"Rigs.{name} has rows {rows.min()} to {rows.max()}, outside 0 to {count - 1}")

    @property
    def num_frames(self) -> int:
        """Number of frames f."""
        return len(self.frame_ids)

    @property
    def num_sensors(self) -> int:
        """Number of sensors s."""
        return len(self.camera_ids)

    @property
    def known(self) -> BoolArray:
        """Mask (s,) of the sensors whose pose in the rig is known."""
        return np.asarray(np.isfinite(self.rotations).all(axis=(1, 2)) & np.isfinite(self.translations).all(axis=1))

    @property
    def centers(self) -> Array:
        """Projection centres (s, 3) of the sensors in the frame of their rig; NaN where not known."""
        return np.asarray(-np.einsum("kba,kb->ka", self.rotations, self.translations))

    def separate(self, sensors: BoolArray) -> "Rigs":
        """Rigs in which some sensors (s,) are rigs of their own, and each image of these is a frame of its own."""
        rig_ids, frame_ids, frame_idx = self.rig_ids.copy(), self.frame_ids, self.frame_idx.copy()
        rig_ids[sensors] = rig_ids.max() + 1 + np.arange(int(sensors.sum()))
        alone = sensors[self.sensor_idx]
        fresh = frame_ids.max() + 1 + np.arange(int(alone.sum()))
        frame_idx[alone] = len(frame_ids) + np.arange(len(fresh))
        return replace(
            self,
            frame_idx=frame_idx,
            frame_ids=np.concatenate([frame_ids, fresh]),
            rig_ids=rig_ids,
            rotations=np.where(sensors[:, None, None], np.eye(3), self.rotations),
            translations=np.where(sensors[:, None], 0.0, self.translations),
            reference=self.reference | sensors,
            separated=sensors,
        )

    @property
    def is_metric(self) -> bool:
        """Whether known distances between sensors tell the scale of the scene."""
        return bool(np.abs(self.centers[self.known]).max(initial=0.0) > 0.0)


@dataclass(frozen=True, eq=False)
class RigPoses:
    """Poses of frames and sensors, in the frame of the images' poses.

    Attributes
    ----------
    frame_rotations : (f, 3, 3) array
        rig_from_world rotations; NaN for frames without a pose.
    frame_centers : (f, 3) array
        Origins of the rigs in the world; NaN for frames without a pose.
    sensor_rotations : (s, 3, 3) array
        sensor_from_rig rotations; NaN for sensors without a pose.
    sensor_centers : (s, 3) array
        Centres of the sensors in their rig, in the unit of the images' centres; NaN for sensors without a pose.
    scale : float
        Factor from the unit of the images' centres to that of the known baselines; 1 where none are known.
    scale_is_certain : bool
        Whether known baselines tell the scale.
    """

    frame_rotations: Array
    frame_centers: Array
    sensor_rotations: Array
    sensor_centers: Array
    scale: float
    scale_is_certain: bool

    @property
    def posed_frames(self) -> BoolArray:
        """Mask (f,) of the frames with a pose."""
        return np.asarray(np.isfinite(self.frame_centers).all(axis=1))

    @property
    def posed_sensors(self) -> BoolArray:
        """Mask (s,) of the sensors with a pose."""
        return np.asarray(np.isfinite(self.sensor_centers).all(axis=1))
