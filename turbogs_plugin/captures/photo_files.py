"""Photo files: those of a folder without cameras, and where the ones lie that a capture names.

`find_photo_folder` is the rule for COLMAP's names, `find_frame_photos` the one for frames of JSON files.
"""

from __future__ import annotations

import itertools
import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, check_photo_name, named
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.errors import InputError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Files that are photos: what both pillow and COLMAP read."""
OTHER_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2")
"""Photos that at least one of them does not read."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".insv")
FRAMES_OF_VIDEO = "ffmpeg -i VIDEO -vf fps=2 -q:v 2 PHOTOS/%05d.jpg"
MASKS = "masks?(_images)?"
"""Names of folders of masks, in any letters; one of them is read (`mask_files.FOLDER`)."""
NO_PHOTOS = re.compile(rf"\..*|images_\d+|{MASKS}", re.IGNORECASE)
"""Folders that hold none: hidden ones, copies reduced by a factor (``images_4``), masks."""
PHOTO_DEPTH = 1
"""Photos are looked for in a folder and in the folders in it. Those of several captures beside each other lie deeper,
in the ``images`` of each."""
ORIGINALS = "input"
"""Where gaussian-splatting's ``convert.py`` keeps the photos that it undistorts into ``images``."""
REDUCED = re.compile(r"_\d+$")
OTHER_IMAGES = re.compile(r"(depth|normal|semantic|segmentation|confidence)s?|.*[_-]masks?", re.IGNORECASE)
"""Folders of images that have the photos' names and are none."""
FOLDER_DEPTH = 2
"""Photos and models are looked for in folders of folders, no deeper."""
REDUCTIONS = (2, 4, 8, 16)
FRAME_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of photos that files of frames name."""


def find_photos(folder: Path) -> tuple[Path, list[Path]]:
    """The photos of a folder; where it has a folder ``images``, of that one.

    Returns:
        The folder that their names are relative to; the photos in the order of their names.
    """
    for place in (folder / "images", folder):
        if photos := [path for path in _files(place, PHOTO_DEPTH) if path.suffix.lower() in PHOTO_SUFFIXES]:
            break
    return place, sorted(photos, key=lambda path: path.relative_to(place).as_posix())


def unread(path: Path) -> str:
    """What to do about photos and videos that are not read: the file `path` itself, or those in a folder; empty where
    there are none."""
    files = _files(path, PHOTO_DEPTH) if path.is_dir() else [path] if path.is_file() else []
    photos = [file for file in files if file.suffix.lower() in OTHER_SUFFIXES]
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    if photos:
        which = "1 file is" if len(photos) == 1 else f"{len(photos)} files are"
        return f"{which} of a kind that is not read ({photos[0].name}): convert to JPEG"
    if videos:
        return f"{videos[0].name} is a video: take photos out of it, as by  {FRAMES_OF_VIDEO}"
    return ""


def _files(folder: Path, depth: int) -> list[Path]:
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    files = [entry for entry in entries if entry.name[0] != "." and entry.is_file()]
    if depth:
        inner = [entry for entry in entries if not NO_PHOTOS.fullmatch(entry.name) and entry.is_dir()]
        files += [file for entry in inner for file in _files(entry, depth - 1)]
    return files


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


def file_named(scene: Path, name: str, source: Path, photo: bool = False) -> str | None:
    """The path, relative to the scene, of the file that a capture names; None where it is not there.

    Separators may be Windows' ones. Of a path of the machine that wrote it, absolute or with '..', the longest end
    counts that is there.

    Args:
        photo: the suffix may lack, as in Blender's names, or be in other letters.

    Raises:
        InputError: a name that cannot be printed.
    """
    path = PureWindowsPath(name)  # knows both kinds of separators, drives and roots
    if not name.isprintable():
        check_photo_name(name, source)
    parts = path.parts[1:] if path.anchor else path.parts
    below = not path.anchor and ".." not in parts
    ends = ["/".join(parts[first:]) for first in range(1 if below else len(parts)) if ".." not in parts[first:]]
    forms = (form for end in ends for form in (_forms(end) if photo else [end]))
    return next((form for form in forms if (scene / form).is_file()), None)


def _forms(name: str) -> list[str]:
    """The names that a photo may have that is called so: with a suffix, or its suffix in other letters."""
    suffix = PurePosixPath(name).suffix
    stem = name.removesuffix(suffix)
    endings = [ending for each in FRAME_SUFFIXES for ending in (each, each.upper())]
    return [name, *(f"{name}{ending}" for ending in endings), f"{stem}{suffix.lower()}", f"{stem}{suffix.upper()}"]


def find_frame_photos(
    scene: Path, names: Sequence[str], others: Collection[str], source: Path
) -> tuple[list[str | None], str, str]:
    """Find the photos that the frames of a file name.

    A photo counts that is where the file says (`file_named`). Where some are, others may have another suffix in the
    same folder, if photos that are there have no such neighbours: these would be masks or depths. Where none is, photos
    are looked for by their file names in the scene and in folders of it, `FOLDER_DEPTH` deep; of several files of one
    name that one counts whose path ends as the photo's does.

    Args:
        others: names of files that are no photos.

    Returns:
        The photos' paths relative to the scene, None for those that are not found, and for all where one name may stand
        for several files or one file for several names; a note on what was found elsewhere; what to add to a line on
        photos that are missing.
    """
    found = [file_named(scene, name, source, photo=True) for name in names]
    if all(found):
        return found, "", ""
    index = _index(scene, {PurePosixPath(other) for other in others})
    exact, note = any(found), ""
    if exact and any(len(_with_stem(index, PureWindowsPath(photo), beside=True)) > 1 for photo in found if photo):
        return found, "", ""
    moved: dict[str, str] = {}
    for name, photo in zip(names, found, strict=True):
        if photo is None:
            best = _candidates(index, PureWindowsPath(name), beside=exact)
            if len(best) > 1 and not exact:
                return found, "", f" ({best[0].name} is in {named([str(scene / file.parent) for file in best])})"
            if len(best) == 1:
                moved[name] = str(best[0])
    taken = Counter([*filter(None, found), *moved.values()])
    twice = [file for file in moved.values() if taken[file] > 1]
    if twice and not exact:
        return found, "", f" ({scene / twice[0]} is of several names)"
    moved = {name: file for name, file in moved.items() if taken[file] == 1}
    if moved:
        name, file = next(iter(moved.items()))
        first = f"{file} is taken for {PureWindowsPath(name).as_posix()}"
        note = f"{len(moved)} photos have another suffix than in {source.name}: {first}, ..."
        if not all(_in_its_folder(PurePosixPath(file), PureWindowsPath(name)) for name, file in moved.items()):
            folders = sorted({str(scene / PurePosixPath(file).parent) for file in moved.values()})
            note = f"photos in {named(folders)}"
    return [photo or moved.get(name) for name, photo in zip(names, found, strict=True)], note, ""


Index = dict[str, list[PurePosixPath]]
"""Paths of files relative to a scene, by their stems in small letters."""


def _index(scene: Path, others: Collection[PurePosixPath]) -> Index:
    """The files of a scene that may be photos, but for `others`."""
    files: Index = defaultdict(list)
    for folder, inner, inside in os.walk(scene, followlinks=True):
        place = PurePosixPath(Path(folder).relative_to(scene).as_posix())
        barred = (name for name in inner if NO_PHOTOS.fullmatch(name) or OTHER_IMAGES.fullmatch(name))
        inner[:] = sorted(filter(str.isprintable, set(inner).difference(barred)))
        if len(place.parts) == FOLDER_DEPTH:
            inner.clear()
        for file in sorted(inside):
            if place / file not in others and PurePosixPath(file).suffix.lower() in FRAME_SUFFIXES:
                files[PurePosixPath(file).stem.lower()].append(place / file)
    return files


def _with_stem(index: Index, name: PureWindowsPath, beside: bool) -> list[PurePosixPath]:
    """Files of a photo's stem, whatever their suffix; `beside`: only those in its folder."""
    # A number after a point is part of the name, and so is what is no suffix.
    stems = [name.name] if name.suffix[1:].isdigit() else [name.stem, name.name]
    files = [file for stem in dict.fromkeys(stems) for file in index.get(stem.lower(), ())]
    return [file for file in files if not beside or _in_its_folder(file, name)]


def _in_its_folder(file: PurePosixPath, name: PureWindowsPath) -> bool:
    """Whether a file lies in the folder that a name says, or an absolute name ends with."""
    parts, others = file.parts[:-1], name.parts[:-1]
    return parts == others or (bool(name.anchor) and bool(parts) and parts == others[-len(parts) :])


def _candidates(index: Index, name: PureWindowsPath, beside: bool) -> list[PurePosixPath]:
    """The files that a name may stand for: of its suffix before others, and of the longest common end of paths."""
    there = _with_stem(index, name, beside)
    there = [file for file in there if file.name.lower() == name.name.lower()] or there
    lengths = [_common_end(file.parts[:-1], name.parts[:-1]) for file in there]
    return [file for file, length in zip(there, lengths, strict=True) if length == max(lengths)]


def _common_end(parts: Sequence[str], others: Sequence[str]) -> int:
    return len(list(takewhile(lambda both: both[0] == both[1], zip(reversed(parts), reversed(others), strict=False))))
