"""From the names of photos that a capture has to files."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from turbogs_plugin.captures.capture import FEWEST_PHOTOS
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.photo_folder import NO_PHOTOS
from turbogs_plugin.errors import InputError

ORIGINALS = "input"
"""Where gaussian-splatting's ``convert.py`` keeps the photos that it undistorts into ``images``."""
REDUCED = re.compile(r"_\d+$")
OTHER_IMAGES = re.compile(r"(depth|normal|semantic|segmentation|confidence)s?|.*[_-]masks?", re.IGNORECASE)
"""Folders of images that have the photos' names and are none."""
FOLDER_DEPTH = 2
"""Photos and models are looked for in folders of folders, no deeper."""
REDUCTIONS = (2, 4, 8, 16)


def find_photo_folder(scene: Path, sizes: Mapping[str, tuple[int, int]]) -> tuple[Path, int]:
    """The folder that the names of the photos are relative to, and by which factor they are reduced there.

    That is ``images`` in the scene, if `FEWEST_PHOTOS` are there: where some of them were taken away, whole folders may
    hold depth maps or another capture's photos of the same names. Else looked at are ``images`` beside the scene, the
    scene itself, the folders in all of these, and ``input`` beside it; then, as not all keep the full-size photos,
    copies of them in ``images_2``, ``images_4``, ... Where none has all the photos it is the first of those that have
    most; not one beside the scene, whose photos may be another one's of the same names.

    Where the first photo that is there has not the size of its camera, and that of the same name in ``input`` has, it
    is that folder: the others are undistorted copies.

    Args:
        sizes: (width, height) of each photo's camera, by the photo's name.
    """
    first, beside = scene / "images", scene.resolve().parent
    there = [name for name in sizes if (first / name).is_file()]
    if len(there) >= FEWEST_PHOTOS or not sizes:
        return _of_cameras(first, scene / ORIGINALS, there, sizes), 1
    places = (first, scene, beside / "images", beside / ORIGINALS)
    whole = ((folder, 1) for place in places for folder in folders_in(place, FOLDER_DEPTH, of_photos=True))
    reduced = ((scene / f"images_{factor}", factor) for factor in REDUCTIONS)
    own: list[tuple[Path, int]] = []
    for folder, reduction in itertools.chain(whole, reduced):
        of_scene = scene in (folder, *folder.parents)
        if all((folder / name).is_file() for name in sizes):
            originals = (scene if of_scene else beside) / ORIGINALS
            return (_of_cameras(folder, originals, list(sizes), sizes) if reduction == 1 else folder), reduction
        if of_scene:  # beside the scene, photos of the same names may be another one's
            own.append((folder, reduction))
    return max(own, key=lambda place: sum((place[0] / name).is_file() for name in sizes))


def _of_cameras(folder: Path, originals: Path, names: list[str], sizes: Mapping[str, tuple[int, int]]) -> Path:
    """`originals`, if they have all the photos `names` too, the first of them in its camera's size, and `folder` has
    that in another size; else `folder`."""
    if not names or not all((originals / name).is_file() for name in names):
        return folder
    taken, size, original = _size_of(folder / names[0]), sizes[names[0]], _size_of(originals / names[0])
    return originals if taken != size == original else folder


def _size_of(photo: Path) -> tuple[int, int] | None:
    try:
        return photo_size(photo)
    except InputError:  # raised again where all photos are read
        return None


def folders_in(place: Path, depth: int, of_photos: bool = False) -> Iterator[Path]:
    """The folder and those in it, nearest first; `of_photos`: not `OTHER_IMAGES`, in which models may lie."""
    level = [place]
    for _ in range(depth + 1):
        yield from level
        try:
            inner = [entry for folder in level if folder.is_dir() for entry in sorted(folder.iterdir())]
        except OSError:
            return
        level = [entry for entry in inner if _is_looked_into(entry, of_photos)]


def _is_looked_into(entry: Path, of_photos: bool) -> bool:
    barred = (NO_PHOTOS, OTHER_IMAGES) if of_photos else (NO_PHOTOS,)
    return not (REDUCED.search(entry.name) or any(each.fullmatch(entry.name) for each in barred)) and entry.is_dir()
