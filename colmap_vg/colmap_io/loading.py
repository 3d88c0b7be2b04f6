"""Load a database's cameras, rigs, frames and images into a `pycolmap.Reconstruction`."""

import pycolmap

from colmap_vg.errors import DatabaseError


def loaded_reconstruction(cache: "pycolmap.DatabaseCache") -> "pycolmap.Reconstruction":
    """Make a reconstruction with all cameras, rigs, frames and images of a database, without poses.

    Raises
    ------
    DatabaseError
        The rigs, frames and images contradict each other.
    """
    reconstruction = pycolmap.Reconstruction()
    _load(reconstruction, cache)
    return reconstruction


def with_other_images(model: "pycolmap.Reconstruction", cache: "pycolmap.DatabaseCache") -> None:
    """Add to a model what only the database holds, in place; what the model holds stays.

    Of its cameras, whether their focal lengths are known is the database's, since COLMAP's files do not tell.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        All that it holds has the ids of the database.
    cache : pycolmap.DatabaseCache

    Raises
    ------
    DatabaseError
        The rigs, frames and images contradict each other.
    """
    own = {}
    # COLMAP refuses to load cameras over those of another camera model.
    for camera_id, camera in model.cameras.items():
        if cache.exists_camera(camera_id):
            own[camera_id] = camera.model, camera.params.tolist()
            camera.model, camera.params = cache.camera(camera_id).model, cache.camera(camera_id).params.tolist()
    try:
        _load(model, cache)
    finally:
        for camera_id, (camera_model, params) in own.items():
            camera = model.camera(camera_id)
            camera.model, camera.params = camera_model, params
            camera.has_prior_focal_length = cache.camera(camera_id).has_prior_focal_length


def _load(reconstruction: "pycolmap.Reconstruction", cache: "pycolmap.DatabaseCache") -> None:
    try:
        reconstruction.load(cache)
    except (ValueError, RuntimeError, IndexError) as error:
        raise DatabaseError(
            f"the database's rigs and frames contradict its images ({error}); extract the features again"
        ) from error
