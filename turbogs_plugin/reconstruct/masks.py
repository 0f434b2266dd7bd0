"""Masks of photos alone, which go with their photos into the capture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageOps
from PIL.ExifTags import Base

from turbogs_plugin.captures.decoding import decoding_threads, opened_image
from turbogs_plugin.captures.mask_files import FOLDER, in_folders, require_mask_size
from turbogs_plugin.files import read_text, write_text_atomically
from turbogs_plugin.reconstruct.photos import PhotoFile, link_or_copy, plain_name


@dataclass(frozen=True)
class MaskFile:
    """A photo's mask on the disk.

    Args:
        name: relative to the capture's folder of masks.
        path: of the file.
        photo: whose mask it is.
        sideways: it is to be turned as its photo is; others have the upright photo's size already.
    """

    name: str
    path: Path
    photo: PhotoFile
    sideways: bool


def find_photo_masks(folder: Path, place: Path, photos: Sequence[PhotoFile]) -> list[MaskFile]:
    """Masks of photos, in a folder of masks in `folder`, in the photos' folder or beside it.

    Args:
        folder: as the user gave it.
        place: folder that the photos' paths begin with.

    Raises:
        InputError: a mask that is no image, or has not its photo's size.
    """
    folders = [parent / FOLDER for parent in dict.fromkeys((folder, place.parent, place))]

    def find(photo: PhotoFile) -> MaskFile | None:
        path = in_folders(folders, photo.path.relative_to(place).as_posix())
        if path is None:
            return None
        stored = photo.size
        if photo.turned:
            with opened_image(photo.path) as image:
                stored = image.size
        with opened_image(path, "mask") as image:
            require_mask_size(path, image.size, photo.path, photo.size, stored)
            sideways = photo.turned and image.size == stored
        inside = path.relative_to(next(each for each in folders if each in path.parents))
        return MaskFile(plain_name(inside), path, photo, sideways)

    with decoding_threads() as pool:
        return [mask for mask in pool.map(find, photos) if mask is not None]


def place_masks(masks: Sequence[MaskFile], folder: Path, listed: Path) -> None:
    """Put masks into a folder, and take away what an earlier call put there. Masks that others put there stay.

    Args:
        listed: file with the names of the masks that calls put there.
    """
    names = [mask.name for mask in masks]
    before = (read_text(listed) or "").splitlines()
    for name in set(before).difference(names):
        (folder / name).unlink(missing_ok=True)
        with suppress(OSError):  # others are in it; the scene itself is never empty
            os.removedirs((folder / name).parent)
    if names != before:  # a finished scene may lie where nothing can be written
        write_text_atomically(listed, "".join(f"{name}\n" for name in names))

    def place(mask: MaskFile) -> None:
        target = folder / mask.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        if not mask.sideways:
            link_or_copy(mask.path, target)
            return
        with Image.open(mask.photo.path) as photo, Image.open(mask.path) as image:
            image.getexif()[Base.Orientation] = photo.getexif()[Base.Orientation]
            ImageOps.exif_transpose(image).save(target, format=image.format)

    with decoding_threads() as pool:
        list(pool.map(place, masks))
