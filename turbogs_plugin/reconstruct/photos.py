"""The photos that a reconstruction begins with: what their files say, and upright copies of them."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from PIL import ImageOps
from PIL.ExifTags import IFD, Base

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, require_printable
from turbogs_plugin.captures.decoding import decoding_threads, opened_image, require_8_bits
from turbogs_plugin.captures.load import run_folder
from turbogs_plugin.captures.mask_files import FOLDER, mask_finder, require_mask_size
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.captures.undistort import PANORAMA_REMEDY
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically

SEPARATORS = re.compile(r"[\s#]")
PANORAMA = re.compile(rb"GPano:ProjectionType\s*(=\s*[\"']|>)\s*(equirectangular|cylindrical|cubemap)", re.IGNORECASE)
KEPT_EXIF = (Base.Make, Base.Model, IFD.Exif, IFD.GPSInfo)
"""EXIF entries that copies which are turned upright keep: what COLMAP reads."""
JPEG_QUALITY = 95
"""Quality of copies that are turned upright. Photos that are upright already stay bit for bit."""


@dataclass(frozen=True)
class PhotoFile:
    """A photo on the disk."""

    name: str  # relative to the folder of photos, by `plain_name`
    path: Path
    size: tuple[int, int]  # (width, height) of the upright photo
    turned: bool  # EXIF says that the file is not upright
    lens: str  # camera, focal length and size: equal for photos of one lens
    stamp: tuple[int, int]  # bytes and time of the last change in ns, by which a later call knows the file again


def plain_name(path: Path) -> str:
    """A relative path with ``/``, and with ``_`` for what COLMAP's lists take for separators."""
    return SEPARATORS.sub("_", path.as_posix())


def read_photos(folder: Path) -> list[PhotoFile]:
    """The photos of a folder, in the order of their names. Each is decoded once, coarsely. Raises `InputError` for no
    folder, or a run's; fewer than `FEWEST_PHOTOS` photos; names that a capture cannot have; a photo that cannot be read
    (the first in order)."""
    reason = f" ({text})" if (text := unread(folder, every=True)) else ""
    if not folder.is_dir():
        raise InputError(f"no such folder of photos: {folder}{reason}")
    if where := run_folder(folder):
        raise InputError(where)
    place, paths = find_photos(folder)
    if len(paths) < FEWEST_PHOTOS:
        needed = f"at least {FEWEST_PHOTOS} are needed, of one scene from different places"
        raise InputError(f"{place if paths else folder} has {len(paths)} photos{reason}: {needed}")
    names = [plain_name(path.relative_to(place)) for path in paths]
    for name in names:
        require_printable(name, place)
    for name, number in Counter(names).items():
        if number > 1:
            raise InputError(f"{number} photos in {place} would be named '{name}' without spaces: rename them")
    with decoding_threads() as pool:
        photos = list(pool.map(_read, paths, names))
    return sorted(photos, key=lambda photo: photo.name)


def place_photos(photos: Sequence[PhotoFile], folder: Path) -> None:
    """Put the photos into a folder: upright ones as links where the disk can, else as copies; the others turned. Files
    that are there already stay."""

    def place(photo: PhotoFile) -> None:
        target = folder / photo.name
        if target.exists():
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        if photo.turned:
            write_atomically(target, partial(_write_upright, photo.path))
        else:
            link_or_copy(photo.path, target)

    with decoding_threads() as pool:
        list(pool.map(place, photos))


def place_masks(folder: Path, place: Path, photos: Sequence[PhotoFile], target: Path) -> None:
    """Put the masks of photos into `target`, from a folder of masks in `folder` (as the user gave it), in the photos'
    folder `place` or beside it. A mask of the stored size of a photo that is not upright is turned as its photo is.
    Raises `InputError` for a mask that is no image, or has not its photo's size."""
    folders = [parent / FOLDER for parent in dict.fromkeys((folder, place.parent, place))]
    find = mask_finder(folders, place)

    def put(photo: PhotoFile) -> None:
        path = find(photo.path.relative_to(place).as_posix())
        if path is None:
            return
        pixels = photo.size[0] * photo.size[1]
        with opened_image(path, "mask", pixels=pixels) as mask, opened_image(photo.path) as image:
            require_mask_size(path, mask.size, photo.path, photo.size, image.size)
            inside = path.relative_to(next(each for each in (*folders, place) if each in path.parents))
            file = target / plain_name(inside)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.unlink(missing_ok=True)
            if photo.turned and mask.size == image.size:
                mask.getexif()[Base.Orientation] = image.getexif()[Base.Orientation]
                turned, form = ImageOps.exif_transpose(mask), mask.format
                write_atomically(file, partial(turned.save, format=form))
            else:
                link_or_copy(path, file)

    with decoding_threads() as pool:
        list(pool.map(put, photos))


def link_or_copy(source: Path, target: Path) -> None:
    """A whole new file `target`, which is not there. Raises `OSError`."""
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, a file of another user
        with open(source, "rb") as file:
            write_atomically(target, lambda copy: shutil.copyfileobj(file, copy))


def _read(path: Path, name: str) -> PhotoFile:
    with opened_image(path, remedy="replace it or take it out") as image:
        size, exif = image.size, image.getexif()
        require_8_bits(image, path)
        xmp = [image.info.get(key, b"") for key in ("xmp", "XML:com.adobe.xmp")]
        if any(PANORAMA.search(text if isinstance(text, bytes) else text.encode()) for text in xmp):
            raise InputError(f"photo {path} is a panorama by its XMP (GPano): {PANORAMA_REMEDY}")
        image.draft("RGB", (size[0] // 8, size[1] // 8))  # JPEG: whole, but at an eighth of the size
        image.load()
        status = path.stat()
    orientation = exif.get(Base.Orientation, 1)
    turned = orientation in range(2, 9)
    upright = size[::-1] if orientation in range(5, 9) else size
    try:
        details = dict(exif.get_ifd(IFD.Exif))
    except Exception:  # damaged, and nothing in EXIF is needed
        details = {}
    focal = (details.get(Base.FocalLength, ""), details.get(Base.FocalLengthIn35mmFilm, ""))
    lens = " ".join(
        str(part).strip("\0 ") for part in (exif.get(Base.Make, ""), exif.get(Base.Model, ""), *focal, *upright)
    )
    return PhotoFile(name, path, upright, turned, lens, (status.st_size, status.st_mtime_ns))


def _write_upright(source: Path, target: BinaryIO) -> None:
    """The photo as EXIF says that it is to be seen, with its camera, focal length and GPS."""
    with opened_image(source) as image:
        form = "JPEG" if image.format == "MPO" else image.format
        exif = image.getexif()
        image.info.pop("exif", None)  # `exif_transpose` would write it again, which Pillow cannot always
        upright = ImageOps.exif_transpose(image)
    for tag in set(exif).difference(KEPT_EXIF):  # a TIFF's say how its pixels are stored
        del exif[tag]
    options: dict[str, Any] = {"quality": JPEG_QUALITY, "subsampling": 0} if form == "JPEG" else {}
    if "icc_profile" in upright.info:
        options["icc_profile"] = upright.info["icc_profile"]
    try:
        upright.save(target, format=form, exif=exif, **options)
    except Exception:  # Pillow cannot write all EXIF that it reads, and nothing in it is needed
        target.seek(0)
        target.truncate()
        upright.save(target, format=form, **options)
