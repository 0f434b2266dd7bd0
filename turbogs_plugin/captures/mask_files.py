"""Masks of a capture: files beside its photos, or the photos' own alpha.

A nonzero pixel of a mask counts, a zero one does not, as COLMAP and nerfstudio have it. A pixel of a photo that is
undistorted or reduced counts if all pixels that it is made of do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from turbogs_plugin.captures import photo_files
from turbogs_plugin.captures.capture import Capture
from turbogs_plugin.captures.decoding import decoding_threads, is_transparent, opened_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks

Size = tuple[int, int]  # (width, height)
FOLDER = "masks"
CONVENTIONS = "NAME.png, NAME.EXTENSION.png or NAME.jpg"
FORMS = ["{stem}.png", "{name}.png", "{name}.mask.png", "{stem}_mask.png", "{name}", "{stem}.jpg", "{stem}.jpeg"]
"""Names of masks in their folder, in any letters, the first that is there before others."""
MASK_PIXELS = 16
"""Pixels of a mask for each of its photo, at most: where the photo is reduced, the mask need not be. An even mask is a
file of few bytes."""
HALF = 128  # value from which a pixel of a JPEG counts, whose compression leaves no exact zeros


def find_masks(scene: Path, capture: Capture, photos: Sequence[Path]) -> tuple[list[Path | None], str]:
    """The file of each photo's mask, None where there is none, and what to tell the user of it. Masks that the capture
    names come first, then those that `mask_finder` finds in the capture or beside the folder of its photos: for photos
    of ``images_4`` in ``masks_4``, and in ``masks``."""
    reduced = re.search(r"_\d+$", photos[0].parents[len(PurePosixPath(capture.names[0]).parts) - 1].name)
    names = [f"{FOLDER}{reduced[0]}", FOLDER] if reduced else [FOLDER]
    parents = dict.fromkeys((scene, capture.photo_folder.parent, capture.photo_folder))
    folders = [parent / name for name in names for parent in parents if (parent / name).is_dir()]
    find = mask_finder(folders, capture.photo_folder)
    found = [file or find(name) for file, name in zip(capture.mask_files, capture.names, strict=True)]
    if files := [file for file in found if file is not None]:
        whole = f"; {len(found) - len(files)} photos without one are whole" if len(files) < len(found) else ""
        return found, f"masks of {len(files)} of {len(found)} photos, as {files[0]}{whole}"
    unused = (f"{folder} is not used: it has no {CONVENTIONS} of a photo" for folder in folders)
    links = (photo_files.broken_link(parent / FOLDER) for parent in parents)
    return found, next(unused, "") or next(filter(None, links), "") or _misnamed(parents) or _beside(photos)


def _misnamed(parents: Iterable[Path]) -> str:
    """A note on the first folder of images that is called like one of masks in these, without a `FOLDER`; or empty."""
    for folder in (entry for parent in parents if parent.is_dir() for entry in sorted(parent.iterdir())):
        if re.fullmatch(photo_files.MASKS, folder.name, re.IGNORECASE) and photo_files.find_photos(folder)[1]:
            return f"{folder} is not used: masks are read from {FOLDER}/; rename it if it holds the photos' masks"
    return ""


def _beside(photos: Sequence[Path]) -> str:
    """A note on masks that lie beside photos; empty where there is none."""
    files = [file for folder in dict.fromkeys(photo.parent for photo in photos) for file in sorted(folder.iterdir())]
    masks = [file.name for file in photo_files.maps_beside(files)]
    remedy = f"masks are read from {FOLDER}/ as {CONVENTIONS}, nonzero where a pixel counts"
    return f"{len(masks)} masks or maps beside the photos are not used ({masks[0]}): {remedy}" if masks else ""


def mask_finder(folders: Sequence[Path], photos: Path) -> Callable[[str], Path | None]:
    """A function from a photo's name in the folder `photos` to its mask in the first of `folders` that has one, or
    beside the photo by RealityScan's convention; None where there is none."""
    exact = [{str(at): folder / at for at in photo_files.files_below(folder, masks=True)} for folder in folders]
    inside = [{photo_files.plain(name): file for name, file in files.items()} | files for files in exact]

    def find(name: str) -> Path | None:
        stem, own = PurePosixPath(name).with_suffix(""), photos / f"{name}{photo_files.MASK_OF_NAME}"
        keys = [form.format(stem=stem, name=name) for form in FORMS]
        found = (files[key] for files in inside for key in (*keys, *map(photo_files.plain, keys)) if key in files)
        return next(found, own if own.is_file() else None)

    return find


def load_masks(
    files: Sequence[Path | None], photos: Sequence[Path], capture: Capture, sizes: np.ndarray, targets: np.ndarray
) -> list[PixelMasks | None]:
    """Masks of V photos, read in parallel, undistorted and reduced as the photos are; None where every pixel counts.

    `sizes`, `targets`: [V, 2] int64 (width, height) of the photos' files, and that the photos get. Where the capture's
    alpha is a mask, the photos' alpha counts, too. Raises `InputError` for a mask that cannot be read, or has neither
    its photo's nor its camera's size.
    """
    full_sizes = capture.photo_sizes

    def load(view: int) -> PixelMasks | None:
        size, target = tuple(sizes[view].tolist()), tuple(targets[view].tolist())
        keep, lens = np.ones(size[::-1], dtype=bool), capture.lenses[view]
        if (file := files[view]) is not None:
            keep &= _read(file, photos[view], size, tuple(full_sizes[view].tolist()))
        if capture.alpha == "mask" and is_transparent(photos[view]):
            with opened_image(photos[view]) as image:
                keep &= np.asarray(image.convert("RGBA").getchannel("A")) > 0
        if keep.all():
            return None
        if lens is not None:
            keep = np.asarray(lens.undistort(Image.fromarray(keep).convert("L"))) == 255
        return PixelMasks.of(_reduced(keep, target))

    with decoding_threads() as pool:
        return list(pool.map(load, range(len(photos))))


def _read(file: Path, photo: Path, size: Size, full_size: Size) -> np.ndarray:
    """[height, width] bool: the mask, in the size of the photo."""
    with opened_image(file, "mask", pixels=MASK_PIXELS * size[0] * size[1]) as image:
        require_mask_size(file, image.size, photo, size, full_size)
        if image.mode == "P":
            image = image.convert("RGBA")
        least = HALF if image.format == "JPEG" else 1
        values = np.asarray(image)
        if image.mode in ("LA", "RGBA"):
            values = values[:, :, :-1] * (values[:, :, -1:] > 0)
        keep = (values.reshape(*values.shape[:2], -1) >= least).any(axis=2)
    return _reduced(np.asarray(keep), size)


def require_mask_size(file: Path, mask_size: Size, photo: Path, size: Size, other: Size) -> None:
    """Raise `InputError` unless a mask has its photo's `size`, or the `other` one that will do."""
    if mask_size not in (size, other):
        mask, wanted = (f"{width}x{height}" for width, height in (mask_size, size))
        remedy = "make it of the photo's size, nonzero where a pixel counts"
        raise InputError(f"mask {file} is {mask} but photo {photo} is {wanted}: {remedy}")


def _reduced(keep: np.ndarray, size: Size) -> np.ndarray:
    """[H, W] bool of `size` (width, height): True where all that a pixel is made of is True."""
    return np.asarray(Image.fromarray(keep).convert("L").resize(size, Image.Resampling.BOX)) == 255
