"""Configure the rigs of a database of features: from COLMAP's rig configuration file, or a camera for each folder."""

from collections import defaultdict
from dataclasses import replace
from os import PathLike
from pathlib import PurePosixPath

import pycolmap

from colmap_vg.errors import ImageFolderError, OptionError
from colmap_vg.options import FeatureOptions


def wants_rigs(options: FeatureOptions) -> bool:
    """Whether the photographs are those of rigs."""
    return options.rig_config_path is not None or options.rigs == "folders"


def with_rig_cameras(options: FeatureOptions) -> FeatureOptions:
    """Options with a camera for each folder, as rigs need, unless another mode was asked for.

    Raises
    ------
    OptionError
        The rig configuration cannot be read, or both kinds of rigs are asked for.
    """
    if options.rig_config_path is not None:
        if options.rigs == "folders":
            raise OptionError("rigs='folders' and rig_config_path exclude each other; give one of them")
        read_rig_config(options.rig_config_path)
    by_folder = wants_rigs(options) and options.camera_mode == "auto"
    return replace(options, camera_mode="per_folder") if by_folder else options


def configure_rigs(database_path: str | PathLike[str], options: FeatureOptions) -> str:
    """Store rigs and frames in a database of features, in place of those that are there.

    Parameters
    ----------
    database_path : path
        With images and cameras; a camera's images are those whose names start with its prefix.
    options : FeatureOptions
        `rig_config_path` or `rigs`.

    Returns
    -------
    str
        How many rigs, cameras and frames there are.

    Raises
    ------
    OptionError
        The configuration cannot be read, or does not fit the images.
    ImageFolderError
        The photographs are not in folders of one camera each, with common names.
    """
    path = options.rig_config_path
    with pycolmap.Database.open(database_path) as database:
        names = [image.name for image in database.read_all_images()]
        configs = rigs_of_folders(names) if path is None else read_rig_config(path)
        try:
            pycolmap.apply_rig_config(configs, database)
        except (ValueError, RuntimeError, IndexError) as error:
            raise OptionError(
                f"the rigs{'' if path is None else f' of {path}'} do not fit the photographs ({error}): a camera's"
                " photographs must have one calibration, and each prefix must match some"
            ) from error
        rigs, frames = database.read_all_rigs(), database.read_all_frames()
    cameras = sum(rig.num_sensors() for rig in rigs)
    return f"{len(rigs)} rigs with {cameras} cameras, {len(frames)} frames"


def read_rig_config(path: str | PathLike[str]) -> list["pycolmap.RigConfig"]:
    """Read COLMAP's rig configuration file (``rig_config.json``).

    Raises
    ------
    OptionError
        The file is missing or is no such configuration.
    """
    try:
        configs = list(pycolmap.read_rig_config(path))
    except (ValueError, RuntimeError, OSError, KeyError) as error:
        raise OptionError(f"cannot read the rig configuration {path} ({error}); check rig_config_path") from error
    if not configs or any(not config.cameras for config in configs):
        raise OptionError(f"the rig configuration {path} has a rig without cameras; check rig_config_path")
    return configs


def rigs_of_folders(names: list[str]) -> list["pycolmap.RigConfig"]:
    """One rig with a camera for each folder; photographs of the same name in different folders are a frame.

    Parameters
    ----------
    names : list of str
        Names of the images, relative to the folder of photographs.

    Raises
    ------
    ImageFolderError
        There is one folder only, or no name occurs in two folders.
    """
    by_folder: dict[str, set[str]] = defaultdict(set)
    for name in names:
        place = PurePosixPath(name)
        by_folder[str(place.parent)].add(place.name)
    if "." in by_folder or len(by_folder) < 2:
        raise ImageFolderError(
            "rigs='folders' needs the photographs of each camera in a folder of its own: found"
            f" {len(by_folder)} folder{'s' if len(by_folder) > 1 else ''}"
            + (f", and {len(by_folder['.'])} photographs in none" if "." in by_folder else "")
        )
    common = sum(len(own) for own in by_folder.values()) - len(set().union(*by_folder.values()))
    if common == 0:
        raise ImageFolderError(
            "rigs='folders' needs the photographs taken at once to have the same name in each camera's folder: no name"
            f" occurs in two of the {len(by_folder)} folders"
        )
    cameras = [
        pycolmap.RigConfigCamera(ref_sensor=number == 0, image_prefix=f"{folder}/")
        for number, folder in enumerate(sorted(by_folder))
    ]
    return [pycolmap.RigConfig(cameras=cameras)]
