"""Lenses whose coefficients the photographs do not tell: they make up for each other, and run away."""

from collections.abc import Callable
from dataclasses import replace

import pycolmap

from colmap_vg.events import StageLog
from colmap_vg.options import MappingOptions

MAX_SANE_COEFFICIENT = 10.0
"""Of a lens's distortion, in COLMAP's models; those of real lenses stay far below."""
MAX_ASPECT = 1.01
"""Of focal lengths in x and y that a simpler model may hold equal."""

_SIMPLER: dict[str, tuple[str, tuple[tuple[int, ...], ...]]] = {
    "FULL_OPENCV": ("OPENCV", ((0,), (1,), (2,), (3,), (4,), (5,), (6,), (7,))),
    "OPENCV_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
    "THIN_PRISM_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
}
"""The same model with fewer coefficients, and which of the full model's parameters each of its own is."""


def tame_lenses(
    reconstruction: "pycolmap.Reconstruction",
    cache: "pycolmap.DatabaseCache",
    options: MappingOptions,
    log: StageLog,
    adjust: Callable[[MappingOptions], object],
) -> None:
    """Take coefficients back that ran away, adjust again, and warn of them.

    Lenses with given coefficients keep these as they came. Others are adjusted under a simpler model, from no
    distortion on, and have their own model again afterwards, the higher coefficients 0.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
        Adjusted, with points.
    cache : pycolmap.DatabaseCache
        With the cameras as they came.
    options : MappingOptions
    log : StageLog
    adjust : callable
        Bundle adjustment of the reconstruction under options.
    """
    wild = _wild(reconstruction) if options.ba_refine_extra_params else []
    given = [i for i in wild if any(cache.camera(i).params[k] for k in cache.camera(i).extra_params_idxs())]
    for camera_id in given:
        lens, came = reconstruction.camera(camera_id), cache.camera(camera_id).params
        lens.params = [came[k] if k in lens.extra_params_idxs() else p for k, p in enumerate(lens.params)]
    if given:
        log.warn(f"The photographs do not tell {_coefficients(reconstruction, given)}; they are kept as they came.")
        adjust(replace(options, ba_refine_extra_params=False))
    simple = [i for i in wild if i not in given and _has_simpler_model(reconstruction.camera(i))]
    if simple:
        log.warn(f"The photographs do not tell the higher of {_coefficients(reconstruction, simple)}; they are 0.")
        models = [_simplify(reconstruction.camera(i)) for i in simple]
        adjust(options)
        for camera_id, (model, size) in zip(simple, models, strict=True):
            _restore(reconstruction.camera(camera_id), model, size)
    _warn_of_wild(reconstruction, log)


def _warn_of_wild(reconstruction: "pycolmap.Reconstruction", log: StageLog) -> None:
    """Warn of lenses whose coefficients are no real lens's."""
    wild = _wild(reconstruction)
    if wild:
        log.warn(
            f"{_coefficients(reconstruction, wild).capitalize()} are up to"
            f" {max(_largest_coefficient(reconstruction.camera(i)) for i in wild):.3g}, which the photographs do not"
            " tell: they hold inside the images only. Use a simpler camera model, or keep the coefficients"
            " (ba_refine_extra_params)."
        )


def _has_simpler_model(lens: "pycolmap.Camera") -> bool:
    if lens.model_name not in _SIMPLER:
        return False
    focal = [lens.params[k] for k in _SIMPLER[lens.model_name][1][0]]
    return bool(max(focal) <= MAX_ASPECT * min(focal))


def _simplify(lens: "pycolmap.Camera") -> tuple[str, int]:
    """Give a camera its simpler model, without distortion; its own model, and how many parameters that has."""
    own, params = lens.model_name, lens.params
    name, rows = _SIMPLER[own]
    undistorted = pycolmap.Camera(model=name, width=lens.width, height=lens.height, params=[0.0] * len(rows))
    first = min(undistorted.extra_params_idxs())
    lens.model = getattr(pycolmap.CameraModelId, name)
    lens.params = [sum(params[k] for k in same) / len(same) if n < first else 0.0 for n, same in enumerate(rows)]
    return own, len(params)


def _restore(lens: "pycolmap.Camera", own: str, size: int) -> None:
    """Give a camera its own model again; coefficients that the simpler one does not have are 0."""
    _, rows = _SIMPLER[own]
    found = {k: value for value, same in zip(lens.params, rows, strict=True) for k in same}
    lens.model, lens.params = getattr(pycolmap.CameraModelId, own), [found.get(k, 0.0) for k in range(size)]


def _wild(reconstruction: "pycolmap.Reconstruction") -> list[int]:
    """Ids of cameras of registered images whose coefficients are no real lens's."""
    used = sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()})
    return [i for i in used if _largest_coefficient(reconstruction.camera(i)) > MAX_SANE_COEFFICIENT]


def _largest_coefficient(lens: "pycolmap.Camera") -> float:
    return max((abs(lens.params[k]) for k in lens.extra_params_idxs()), default=0.0)


def _coefficients(reconstruction: "pycolmap.Reconstruction", camera_ids: list[int]) -> str:
    others = f" and {len(camera_ids) - 1} more" if len(camera_ids) > 1 else ""
    name = reconstruction.camera(camera_ids[0]).model_name
    return f"the coefficients of the {name} lens of camera {camera_ids[0]}{others}"
