"""Load a database's cameras, rigs, frames and images into a `pycolmap.Reconstruction` without poses."""

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
    try:
        reconstruction.load(cache)
    except (ValueError, RuntimeError, IndexError) as error:
        raise DatabaseError(
            f"the database's rigs and frames contradict its images ({error}); extract the features again"
        ) from error
    return reconstruction
