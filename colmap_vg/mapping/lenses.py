"""Reset distortion coefficients that the images do not determine, and warn of lenses that are hardly real."""

from collections.abc import Callable
from dataclasses import replace

import pycolmap

from colmap_vg.colmap_io.cameras import is_undistorted
from colmap_vg.events import StageLog
from colmap_vg.options import MappingOptions

MAX_SANE_COEFFICIENT = 10.0
"""Distortion coefficient, in the units of COLMAP's camera models, above which it has diverged; real lenses stay far
below."""
START_FOV_ANGLE = 0.3
"""Parameter of FOV cameras without distortion at the start of bundle adjustment, radians: 1 % at 30 degrees."""
MAX_ASPECT = 1.01
"""Maximum ratio of the focal lengths in x and y for a camera model with a single one."""

MAX_STRETCH = 1.1
"""Maximum factor by which bundle adjustment changes the ratio of the focal lengths in x and y without a warning: pixels
are square, or as the calibration has them, to a per cent."""

_SIMPLER: dict[str, tuple[str, tuple[tuple[int, ...], ...]]] = {
    "FULL_OPENCV": ("OPENCV", ((0,), (1,), (2,), (3,), (4,), (5,), (6,), (7,))),
    "OPENCV_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
    "THIN_PRISM_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("RADIAL_FISHEYE", ((0, 1), (2,), (3,), (4,), (5,))),
}
"""For each camera model, a model with fewer coefficients, and for each of its parameters the indices of the full
model's parameters that it stands for."""


def bend_undistorted_fov(reconstruction: "pycolmap.Reconstruction") -> None:
    """Give FOV cameras without distortion a little, from which bundle adjustment can find theirs.

    Their distortion is even in the parameter: without any, its derivative vanishes and steps are far too large.
    """
    for camera in reconstruction.cameras.values():
        if camera.model_name == "FOV" and is_undistorted(camera):
            camera.params = [*camera.params[:4].tolist(), START_FOV_ANGLE]


def reset_diverged_lenses(
    reconstruction: "pycolmap.Reconstruction",
    cache: "pycolmap.DatabaseCache",
    options: MappingOptions,
    log: StageLog,
    adjust: Callable[[MappingOptions], object],
) -> frozenset[int]:
    """Reset distortion coefficients that diverged, repeat bundle adjustment, and warn of them.

    Coefficients given at the start are reset to their initial values. Cameras that started without distortion are
    adjusted with a simpler model, then get their own model back with its higher coefficients set to 0.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
        Adjusted, with points.
    cache : pycolmap.DatabaseCache
        With the initial cameras.
    options : MappingOptions
    log : StageLog
    adjust : callable
        Runs bundle adjustment of the reconstruction with the given options.

    Returns
    -------
    frozenset of int
        Ids of the cameras that a warning names.
    """
    diverged = _diverged(reconstruction) if options.ba_refine_extra_params else []
    given = [i for i in diverged if any(cache.camera(i).params[k] for k in cache.camera(i).extra_params_idxs())]
    simple = [i for i in diverged if i not in given and _has_simpler_model(reconstruction.camera(i))]
    if simple:
        coefficients = _coefficients(reconstruction, simple)
        log.warn(f"The images do not determine the higher-order terms of {coefficients}; they are set to 0.")
        models = [_simplify(reconstruction.camera(i)) for i in simple]
        adjust(options)
        for camera_id, (model, size) in zip(simple, models, strict=True):
            _restore(reconstruction.camera(camera_id), model, size)
    # This comes last because bundle adjustment then refines no coefficients at all.
    for camera_id in given:
        lens, initial = reconstruction.camera(camera_id), cache.camera(camera_id).params
        lens.params = [initial[k] if k in lens.extra_params_idxs() else p for k, p in enumerate(lens.params)]
    if given:
        coefficients = _coefficients(reconstruction, given)
        log.warn(f"The images do not determine {coefficients}; they are kept at their initial values.")
        adjust(replace(options, ba_refine_extra_params=False))
    _warn_of_diverged(reconstruction, log)
    return frozenset(diverged)


def warn_of_stretched(
    reconstruction: "pycolmap.Reconstruction", cache: "pycolmap.DatabaseCache", log: StageLog
) -> None:
    """Warn of cameras whose focal lengths in x and y bundle adjustment moved apart: the model may be stretched, too.

    On a turntable the keypoints tell one of them only loosely, and errors that are no noise decide it.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
        Adjusted.
    cache : pycolmap.DatabaseCache
        With the initial cameras.
    log : StageLog
    """
    used = sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()})
    pairs = {i: [_aspect(lenses.camera(i)) for lenses in (cache, reconstruction)] for i in used}
    stretched = {i: pair for i, pair in pairs.items() if max(pair) > MAX_STRETCH * min(pair)}
    if stretched:
        camera_id, (before, after) = next(iter(stretched.items()))
        log.warn(
            f"Bundle adjustment changed the ratio of the focal lengths in x and y of {len(stretched)} cameras (first:"
            f" {camera_id}, from {before:.3g} to {after:.3g}): the images determine it only loosely, and the model may"
            " be stretched. Choose a camera model with one focal length, as SIMPLE_RADIAL, or keep the focal lengths"
            " (ba_refine_focal_length)."
        )


def _aspect(lens: "pycolmap.Camera") -> float:
    """Focal length in x over that in y; 1 with a single one."""
    focal = [float(lens.params[k]) for k in lens.focal_length_idxs()]
    return focal[0] / focal[1] if len(focal) == 2 and focal[1] > 0.0 else 1.0


def _warn_of_diverged(reconstruction: "pycolmap.Reconstruction", log: StageLog) -> None:
    """Warn of cameras whose distortion coefficients diverged."""
    diverged = _diverged(reconstruction)
    if diverged:
        largest = max(_largest_coefficient(reconstruction.camera(i)) for i in diverged)
        log.warn(
            f"The images do not determine {_coefficients(reconstruction, diverged)}, which reach {largest:.3g}: the"
            " calibration is valid inside the images only. Choose a camera model with fewer coefficients, or do not"
            " refine them (ba_refine_extra_params)."
        )


def _has_simpler_model(lens: "pycolmap.Camera") -> bool:
    if lens.model_name not in _SIMPLER:
        return False
    focal = [lens.params[k] for k in _SIMPLER[lens.model_name][1][0]]
    return bool(max(focal) <= MAX_ASPECT * min(focal))


def _simplify(lens: "pycolmap.Camera") -> tuple[str, int]:
    """Set a camera to its simpler model, without distortion; return its own model and the number of its parameters."""
    own, params = lens.model_name, lens.params
    name, rows = _SIMPLER[own]
    undistorted = pycolmap.Camera(model=name, width=lens.width, height=lens.height, params=[0.0] * len(rows))
    first = min(undistorted.extra_params_idxs())
    lens.model = getattr(pycolmap.CameraModelId, name)
    lens.params = [sum(params[k] for k in same) / len(same) if n < first else 0.0 for n, same in enumerate(rows)]
    return own, len(params)


def _restore(lens: "pycolmap.Camera", own: str, size: int) -> None:
    """Set a camera back to its own model; coefficients that the simpler model lacks are 0."""
    _, rows = _SIMPLER[own]
    found = {k: value for value, same in zip(lens.params, rows, strict=True) for k in same}
    lens.model, lens.params = getattr(pycolmap.CameraModelId, own), [found.get(k, 0.0) for k in range(size)]


def _diverged(reconstruction: "pycolmap.Reconstruction") -> list[int]:
    """Ids of the cameras of registered images whose distortion coefficients diverged."""
    used = sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()})
    return [i for i in used if _largest_coefficient(reconstruction.camera(i)) > MAX_SANE_COEFFICIENT]


def _largest_coefficient(lens: "pycolmap.Camera") -> float:
    return max((abs(lens.params[k]) for k in lens.extra_params_idxs()), default=0.0)


def _coefficients(reconstruction: "pycolmap.Reconstruction", camera_ids: list[int]) -> str:
    others = f" and {len(camera_ids) - 1} more" if len(camera_ids) > 1 else ""
    name = reconstruction.camera(camera_ids[0]).model_name
    return f"the distortion coefficients of the {name} lens of camera {camera_ids[0]}{others}"
