"""Find the mask file of each photograph, and check that it can be used."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

from colmap_vg.errors import ImageFolderError
from colmap_vg.features.photographs import Photograph, SkippedFile, check_photograph

_MASK_ENDINGS = (".png", ".mask.png", ".jpg", ".jpeg", ".mask.jpg", ".mask.jpeg")


def with_masks(
    photographs: Sequence[Photograph], image_path: str | PathLike[str], mask_path: str | PathLike[str]
) -> tuple[list[Photograph], list[SkippedFile]]:
    """Find the masks of photographs, and skip photographs whose mask cannot be used.

    The mask of ``folder/a.jpg`` is ``folder/a.jpg.png`` or ``folder/a.png``, as in COLMAP, or one of these with
    ``.mask.png``, ``.jpg`` or ``.mask.jpg`` in place of ``.png``. It must have the photograph's size.

    Parameters
    ----------
    photographs : sequence of Photograph
    image_path, mask_path : path

    Returns
    -------
    kept : list of Photograph
        Photographs with their masks, and those without one; files that are masks of others are dropped.
    skipped : list of SkippedFile

    Raises
    ------
    ImageFolderError
        The folder of masks does not exist, or has a mask for none of the photographs.
    """
    masks = Path(mask_path)
    if not masks.is_dir():
        raise ImageFolderError(f"the mask folder {masks} does not exist; check mask_path")
    kept, skipped = [], []
    for photograph in photographs:
        mask = _mask_of(photograph.name, Path(image_path), masks)
        checked = None if mask is None else check_photograph(mask, str(mask))
        if isinstance(checked, SkippedFile):
            skipped.append(SkippedFile(photograph.name, f"its mask {mask} cannot be used: {checked.reason}"))
        elif checked is not None and (checked.width, checked.height) != (photograph.width, photograph.height):
            sizes = f"{checked.width} x {checked.height} pixels, not {photograph.width} x {photograph.height}"
            skipped.append(SkippedFile(photograph.name, f"its mask {mask} is {sizes}"))
        else:
            kept.append(replace(photograph, mask=mask))
    used = {photograph.mask.resolve() for photograph in kept if photograph.mask is not None}
    kept = [photograph for photograph in kept if (Path(image_path) / photograph.name).resolve() not in used]
    if kept and not skipped and all(photograph.mask is None for photograph in kept):
        first = kept[0].name
        raise ImageFolderError(
            f"no photograph has a mask in {masks}: the mask of {first} is {first}.png or"
            f" {Path(first).with_suffix('.png')} there; check mask_path"
        )
    return kept, skipped


def _mask_of(name: str, images: Path, masks: Path) -> Path | None:
    """The mask file of a photograph, but never the photograph itself if masks are in the same folder; None without."""
    own = images / name
    named = (
        (masks / base).with_name((masks / base).name + ending)
        for ending in _MASK_ENDINGS
        for base in (name, Path(name).with_suffix("").as_posix())
    )
    return next((path for path in named if path.is_file() and not path.samefile(own)), None)
