"""Photo files: the photos of a folder without cameras, and the photos that a capture names."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, require_printable
from turbogs_plugin.errors import InputError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Suffixes of photos that both pillow and COLMAP read."""
OTHER_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2")
"""Suffixes of photos that at least one of them does not read."""
NAMED_SUFFIXES = (*PHOTO_SUFFIXES, ".webp", ".avif", ".jp2")
"""Suffixes of files that may stand for a photo that is not where a capture names it."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".insv")
FRAMES_OF_VIDEO = "ffmpeg -i VIDEO -vf fps=2 -q:v 2 PHOTOS/%05d.jpg"
MASKS = "masks?(_images)?"
"""Names of folders of masks, in any letters; one of them is read (`mask_files.FOLDER`)."""
NO_PHOTOS = re.compile(rf"\..*|images_\d+|{MASKS}", re.IGNORECASE)
"""Folders without photos: hidden ones, copies reduced by a factor (``images_4``), masks."""
OTHER_IMAGES = re.compile(r"(depth|normal|semantic|segmentation|confidence)s?|.*[_-]masks?", re.IGNORECASE)
"""Folders of images that have the photos' names and are none."""
PHOTO_DEPTH = 1
"""Photos are looked for in a folder and in the folders in it. The photos of several captures beside each other lie
deeper, in the ``images`` of each."""
FOLDER_DEPTH = 4
"""Named photos are looked for in folders of a capture, no deeper than this."""
IMAGES, REDUCED = "images", tuple(f"images_{factor}" for factor in (2, 4, 8, 16))
"""Folder of the photos, and of copies reduced by a factor."""


def find_photos(folder: Path) -> tuple[Path, list[Path]]:
    """The photos of a folder; where it has a folder ``images``, of that one.

    Returns:
        The folder that their names are relative to; the photos in the order of their names.
    """
    for place in (folder / IMAGES, folder):
        if photos := [path for path in _files(place, PHOTO_DEPTH) if path.suffix.lower() in PHOTO_SUFFIXES]:
            break
    return place, sorted(photos, key=lambda path: path.relative_to(place).as_posix())


def unread(path: Path) -> str:
    """Advice on photos and videos that are not read, of the file `path` or in a folder; empty where there are none."""
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


def file_named(scene: Path, name: str, source: Path, folder: str = "") -> str | None:
    """The path, relative to the scene, of a file that a capture names; None where it is not there.

    Separators may be Windows' ones. Of a path of the machine that wrote it, absolute or with '..', the longest end
    counts that is there, so the file lies in the scene.

    Args:
        folder: of the scene, that names are relative to.

    Raises:
        InputError: a name that cannot be printed.
    """
    require_printable(name, source)
    path = PureWindowsPath(name)  # knows both kinds of separators, drives and roots
    parts = path.parts[1:] if path.anchor else path.parts
    below = not path.anchor and ".." not in parts
    ends = [parts[first:] for first in range(1 if below else len(parts)) if parts and ".." not in parts[first:]]
    forms = (PurePosixPath(folder, *end).as_posix() for end in ends)
    return next((form for form in forms if (scene / form).is_file()), None)


def find_named(
    scene: Path,
    names: Sequence[str],
    source: Path,
    folders: Sequence[str],
    others: Collection[str] = (),
    anywhere: bool = True,
) -> tuple[list[str | None], list[str]]:
    """The photos that a capture names: the one rule for every kind of capture.

    - A photo counts that is where its name says (`file_named`), in the first of `folders` that has it; where fewer than
      `FEWEST_PHOTOS` are, in ``images_2``, ``images_4``, ...
    - Another name stands for a file in the folder that it says, of any suffix and in any letters. Where photos have
      neighbours of other suffixes (masks, depths), it stands for none.
    - Where no name is found so, names stand for files in the scene and in folders of it, `FOLDER_DEPTH` deep; for none
      where a file may be meant by two names, or a name by two files.

    Of several files for a name, one of its suffix counts before others, then one whose path ends as the name does.

    Args:
        folders: in the scene, that names are relative to; '' for the scene itself.
        others: names of files that are no photos.
        anywhere: the last rule is followed.

    Returns:
        The photos' paths relative to the scene, None where there is no photo; a note or none on photos that are not
        where their names say.

    Raises:
        InputError: a name that cannot be printed, or that is there twice.
    """
    places = (folders, *((folder,) for folder in REDUCED))
    tries = ([_first_there(scene, name, source, place) for name in names] for place in places)
    first = next(tries)
    found = first if _count(first) >= FEWEST_PHOTOS else next((each for each in tries if _count(each)), first)
    plain = [path or PureWindowsPath(name).as_posix() for path, name in zip(found, names, strict=True)]
    if twice := [path for path, times in Counter(plain).items() if times > 1]:
        raise InputError(f"{source} names the photo {twice[0]} twice: take one out, or rename the photos")
    moved: dict[int, str] = {}
    if None in found:
        index = _index(scene, {PurePosixPath(other) for other in others})
        if not any(len(_like(index, PureWindowsPath(path), [""])) > 1 for path in filter(None, found)):
            missing = {place: PureWindowsPath(names[place]) for place, path in enumerate(found) if path is None}
            moved, _ = _moved(index, missing, folders)
            moved = {place: path for place, path in moved.items() if path not in found}  # another name's photo
            if anywhere and not moved and not any(found):
                moved, clear = _moved(index, missing, None)
                moved = moved if clear else {}
    paths = [moved.get(place, path) for place, path in enumerate(found)]
    return paths, _moved_note(names, moved, source)


def _first_there(scene: Path, name: str, source: Path, folders: Sequence[str]) -> str | None:
    return next((path for folder in folders if (path := file_named(scene, name, source, folder))), None)


def _count(found: Sequence[str | None]) -> int:
    return sum(path is not None for path in found)


def common_folder(scene: Path, paths: Sequence[str]) -> Path:
    """The folder in the scene that all photos lie in, whose paths are relative to the scene; else the scene itself."""
    first = {parts[0] if len(parts := PurePosixPath(path).parts) > 1 else "" for path in paths}
    return scene / first.pop() if len(first) == 1 else scene


def _moved_note(names: Sequence[str], moved: dict[int, str], source: Path) -> list[str]:
    """A line on photos that are not where their names say, but for a suffix that names lack."""
    pairs = [(path, PureWindowsPath(names[place]).as_posix()) for place, path in moved.items()]
    pairs = [(path, name) for path, name in pairs if str(PurePosixPath(path).with_suffix("")) != name]
    if not pairs:
        return []
    path, name = pairs[0]
    return [f"{len(pairs)} photos are not where {source.name} says: {path} is taken for {name}, ..."]


Index = dict[str, list[PurePosixPath]]
"""Paths of files relative to a scene, by their stems in `_plain` letters."""


def _plain(text: str) -> str:
    return unicodedata.normalize("NFC", text).lower()


def _index(scene: Path, others: Collection[PurePosixPath]) -> Index:
    """The files of a scene that may be photos, but for `others`."""
    files: Index = defaultdict(list)
    for folder, inner, inside in os.walk(scene, followlinks=True):
        place = PurePosixPath(Path(folder).relative_to(scene).as_posix())
        barred = (name for name in inner if NO_PHOTOS.fullmatch(name) or OTHER_IMAGES.fullmatch(name))
        inner[:] = sorted(filter(str.isprintable, set(inner).difference(barred)))
        if len(place.parts) == FOLDER_DEPTH:
            inner.clear()
        for file in map(PurePosixPath, sorted(inside)):
            if place / file not in others and file.suffix.lower() in NAMED_SUFFIXES:
                files[_plain(file.stem)].append(place / file)
    return files


def _like(index: Index, name: PureWindowsPath, folders: Sequence[str] | None) -> list[PurePosixPath]:
    """The files of a name's stem, in any letters and of any suffix.

    Args:
        folders: that names are relative to, in which alone files count; None: files of any folder count.
    """
    # A number after a point is part of the name, and so is what is no suffix.
    stems = [name.name] if name.suffix[1:].isdigit() else [name.stem, name.name]
    files = [file for stem in dict.fromkeys(stems) for file in index.get(_plain(stem), ())]
    if folders is None:
        return files
    parts = name.parts[bool(name.anchor) : -1]
    places = {PurePosixPath(folder, *parts) for folder in folders}
    own = (file for file in files if file.parent in places or (name.anchor and _common_end(file, name) > 0))
    return list(own)


def _moved(
    index: Index, names: dict[int, PureWindowsPath], folders: Sequence[str] | None
) -> tuple[dict[int, str], bool]:
    """The one file that each name stands for, and whether no name has several files, and no file several names."""
    moved, clear = {}, True
    for place, name in names.items():
        files = _like(index, name, folders)
        files = [file for file in files if _plain(file.name) == _plain(name.name)] or files
        nearest = max((_common_end(file, name) for file in files), default=0)
        files = [file for file in files if _common_end(file, name) == nearest]
        clear &= len(files) < 2
        if len(files) == 1:
            moved[place] = str(files[0])
    times = Counter(moved.values())
    return {place: path for place, path in moved.items() if times[path] == 1}, clear and len(times) == len(moved)


def _common_end(file: PurePosixPath, name: PureWindowsPath) -> int:
    """The number of equal folders at the end of both paths."""
    pairs = zip(reversed(file.parts[:-1]), reversed(name.parts[:-1]), strict=False)
    return len(list(takewhile(lambda both: both[0] == both[1], pairs)))
