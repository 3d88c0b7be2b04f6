"""Write synthetic views as a COLMAP database with keypoints, matches and two-view geometries, without descriptors."""

from os import PathLike

import numpy as np
import pycolmap

from colmap_vg.simulation.views import FOCAL_PX, HEIGHT, WIDTH, SyntheticViews
from colmap_vg.two_view.essential import essential_from_pose

CAMERA_ID = 1


def write_synthetic_database(database_path: str | PathLike[str], views: SyntheticViews) -> None:
    """Write views to a new database with one calibrated pinhole camera and images 1, 2, ... named by their rows.

    Parameters
    ----------
    database_path : path
        Must not exist yet.
    views : SyntheticViews
    """
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL_PX, WIDTH / 2, HEIGHT / 2],
        camera_id=CAMERA_ID,
        has_prior_focal_length=True,
    )
    K = camera.calibration_matrix()
    inverse = np.linalg.inv(K)
    E = essential_from_pose(views.relative_rotations, views.directions)
    translations = -np.einsum("kab,kb->ka", views.relative_rotations, views.directions)
    with pycolmap.Database.open(database_path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for row, keypoints in enumerate(views.keypoints):
            image = pycolmap.Image(name=f"{row:05d}.jpg", camera_id=CAMERA_ID, image_id=row + 1)
            image.frame_id = row + 1
            frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(row + 1, keypoints.astype(np.float32))
        for k, ((i, j), matches) in enumerate(zip(views.pairs + 1, views.matches, strict=True)):
            inliers = matches.astype(np.uint32)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.E = E[k]
            geometry.F = inverse.T @ E[k] @ inverse
            geometry.cam2_from_cam1 = pycolmap.Rigid3d(
                pycolmap.Rotation3d(views.relative_rotations[k]), translations[k]
            )
            geometry.inlier_matches = inliers
            database.write_matches(int(i), int(j), inliers)
            database.write_two_view_geometry(int(i), int(j), geometry)
