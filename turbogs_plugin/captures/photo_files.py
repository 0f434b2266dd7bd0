"""Photo files: the photos of a folder without cameras, and the photos that a capture names."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, named, require_printable
from turbogs_plugin.errors import InputError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")  # of photos that both pillow and COLMAP read
OTHER_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2")
"""Suffixes of photos that at least one of them does not read, and that may stand for others (`_stem`)."""
NAMED_SUFFIXES = (*PHOTO_SUFFIXES, ".webp", ".avif", ".jp2")
"""Suffixes of files that may stand for a photo that is not where a capture names it, as Pillow reads them."""
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
UNREAD = {
    "convert to JPEG": (*OTHER_SUFFIXES, ".exr", ".hdr", ".raf", ".raw", ".pef", ".jfif", ".jp2", ".gif", ".psd"),
    "it is of a 360 degree camera: export flat views of it": (".insp", ".insv", ".360"),
    "unpack it": (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar"),
    "it is Record3D's: 'ns-process-data record3d' makes a capture of it": (".r3d",),
    "it is a video: take photos out of it, as by  ffmpeg -i VIDEO -vf fps=2 -q:v 2 PHOTOS/%05d.jpg": VIDEOS,
}
"""Suffixes of files that are not read, by what to do with them."""
MASKS = "(.*[_. -])?(mask|matte|segmentation)s?(_images)?"  # names of masks' folders; one is read (`mask_files.FOLDER`)
MASK_OF_NAME = ".mask.png"  # RealityScan's masks are ``NAME.EXTENSION.mask.png``, beside the photos, too
_MAPS = "(?:mask|matte|depth|disparity|normal|albedo|semantic|seg|segmentation|instance|label|conf|confidence)s?"
_MAPS += "(?:[_-]?(?:map|image|vi[sz])s?)?"
NO_PHOTOS = re.compile(rf"\..*|images_\d+|(?:.*[_. -])?{_MAPS}(?:_\d+)?", re.IGNORECASE)
"""Folders without photos: hidden ones, copies reduced by a factor (``images_4``), masks, maps of depth and others."""
MAPS_OF = (rf"(.+?)[._ -]?(?:{_MAPS}|alpha)(?:[_-]?\d+)?", rf"(?:dynamic_)?{_MAPS}[._ -](.+)")
"""Stems of files that are no photos where the photo lies beside them that they are made from (the group)."""
PHOTO_DEPTH = 1
"""Photos are looked for in a folder and in the folders in it. The photos of several captures beside each other lie
deeper, in the ``images`` of each."""
FOLDER_DEPTH = 4  # named photos are looked for in folders of a capture, no deeper than this
DEEPEST = 16  # folders of a name that are looked at, the last ones
IMAGES, REDUCED = "images", tuple(f"images_{factor}" for factor in (2, 4, 8, 16))  # of photos, and of reduced copies


def find_photos(folder: Path) -> tuple[Path, list[Path]]:
    """The photos of a folder in the order of their names; where it has a folder ``images``, of that one. And the folder
    that their names are relative to, first."""
    for place in (folder / IMAGES, folder):
        files = [place / path for path in files_below(place, PHOTO_DEPTH) if path.suffix.lower() in PHOTO_SUFFIXES]
        if photos := set(files).difference(maps_beside(files)):
            break
    return place, sorted(photos, key=lambda path: path.relative_to(place).as_posix())


def maps_beside(files: Iterable[Path]) -> list[Path]:
    """Files among these that are masks or maps of others: ``a.jpg.mask.png`` or ``a_depth.png`` beside ``a.jpg``."""
    files = list(files)
    bases = {file.parent / base for file in files for base in (file.name.lower(), file.stem.lower())}
    matches = ((file, re.fullmatch(form, file.stem.lower())) for file in files for form in MAPS_OF)
    return list(dict.fromkeys(file for file, match in matches if match and file.parent / match[1] in bases))


def unread(path: Path, every: bool = False) -> str:
    """What is not read of the file `path` or in a folder, and what to do; or empty. `every`: also files of kinds that
    captures have nothing to do with."""
    entries = [path, *(path.iterdir() if path.is_dir() else ()), *((path / IMAGES).glob("*"))]
    said = [link for entry in sorted(entries) if (link := broken_link(entry))][:1]
    files = [path] if path.is_file() else [path / file for file in files_below(path, PHOTO_DEPTH)]
    for advice, suffixes in UNREAD.items():
        if some := [file.name for file in files if file.suffix.lower() in suffixes]:
            which = "1 file is" if len(some) == 1 else f"{len(some)} files are"
            said.append(f"{which} of a kind that is not read ({some[0]}): {advice}")
    maps = maps_beside(file for file in files if file.suffix.lower() in PHOTO_SUFFIXES)
    if maps := [file for file in maps if not file.name.endswith(MASK_OF_NAME)]:
        said.append(f"{len(maps)} files are masks or maps of photos by their names, no photos ({maps[0].name})")
    for entry in sorted(entries[1:]):  # but for what is hidden, or read for what it is
        if NO_PHOTOS.fullmatch(entry.name) and not re.fullmatch(r"\..*|(images|masks)_\d+|masks", entry.name):
            said += [f"{entry.name}/ holds no photos by its name"] if find_photos(entry)[1] else []
    strange = [file.name for file in files if file.suffix.lower() not in PHOTO_SUFFIXES]
    if every and strange and not said:
        said.append(f"{named(strange)} cannot be read as photos")
    return "; ".join(said)


def broken_link(path: Path) -> str:
    """A line where a path, or a folder that it lies in, is a link to what is not there; or empty."""
    broken = (part for part in (path, *path.parents) if part.is_symlink() and not part.exists())
    return next((f"{part} is a link to {os.readlink(part)}, which is not there: copy that here" for part in broken), "")


def files_below(folder: Path, depth: int = FOLDER_DEPTH, masks: bool = False) -> Iterator[PurePosixPath]:
    """Paths of files relative to a folder that they lie in, in no folder that is hidden or, but with `masks`, one of
    `NO_PHOTOS`."""
    for place, inner, files in os.walk(folder, followlinks=True):
        at = PurePosixPath(Path(place).relative_to(folder).as_posix())
        allowed = [name for name in inner if name.isprintable() and (masks or not NO_PHOTOS.fullmatch(name))]
        inner[:] = sorted(allowed) if len(at.parts) < depth else []
        yield from (at / file for file in sorted(files) if file[0] != "." and (Path(place) / file).is_file())


def file_named(scene: Path, name: str, source: Path, folders: Sequence[str] = ("",)) -> str | None:
    """The path, relative to the scene, of a file that a capture names relative to folders of it (`_forms`), the first
    that has it; None where none has. Raises `InputError` for a name that cannot be printed."""
    require_printable(name, source)
    return next((form for form in _forms(name, folders) if os.path.isfile(f"{scene}/{form}")), None)


def _forms(name: str, folders: Sequence[str]) -> Iterator[str]:
    """The paths in a scene that a name may mean in each folder: the name there; of a path of the machine that wrote it,
    absolute or with '..', each of its ends of `DEEPEST` parts and fewer, the longest first. Separators may be Windows'
    ones. A copy of ``images/a.png`` is ``images_2/a.png``."""
    path = PureWindowsPath(name)  # knows both kinds of separators, drives and roots
    for folder in folders:
        parts = path.parts[bool(path.anchor) or (folder in REDUCED and path.parts[:1] == (IMAGES,)) :][-DEEPEST:]
        ends = [parts[start:] for start in range(len(parts) if path.anchor or ".." in parts else min(1, len(parts)))]
        yield from ("/".join((folder, *end) if folder else end) for end in ends if ".." not in end)


class FoundPhotos(NamedTuple):
    """The photos of a capture that are there, in the order of their names, and notes on those that are not."""

    folder: Path  # that all of them lie in: one in the scene, else the scene
    names: tuple[str, ...]  # relative to the folder
    places: list[int]  # among the names that the capture has
    notes: list[str]


def find_named(
    scene: Path, names: Sequence[str], source: Path, folders: Sequence[str], others: Collection[str] = ()
) -> FoundPhotos:
    """The photos that a capture names: the one rule for every kind of capture.

    - A photo counts that is where its name says (`file_named`), in the first of `folders` that has it; where fewer than
      `FEWEST_PHOTOS` are, in ``images_2``, ``images_4``, ...
    - Another name stands for a file in the folder that it says, of any suffix, in any letters and any form of Unicode.
    - Where no name is found so, names stand for files in the scene and in folders of it, `FOLDER_DEPTH` deep.

    Of several files for a name, one of its suffix counts before others, then one whose path ends as the name does. A
    name with several files left, and names with one file in common, stand for none.

    Args:
        folders: in the scene, that names are relative to; '' for the scene itself.
        others: names of files that are no photos.

    Raises:
        InputError: a name that cannot be printed, a photo that is named twice, or fewer than `FEWEST_PHOTOS` photos.
    """
    reduced = ([folder] for folder in REDUCED if (scene / folder).is_dir())
    for places in (folders, *reduced, folders):
        found = [file_named(scene, name, source, places) for name in names]
        if len(found) - found.count(None) >= FEWEST_PHOTOS:
            break
    written = [path or PureWindowsPath(name).as_posix() for path, name in zip(found, names, strict=True)]
    if twice := [path for path, times in Counter(written).items() if times > 1]:
        raise InputError(f"{source} names the photo {twice[0]} twice: take one out, or rename the photos")
    missing = [place for place, path in enumerate(found) if path is None]
    index = defaultdict(list)  # files of the scene that may be photos, by their stems
    no_photos = {*written, *(PureWindowsPath(other).as_posix() for other in others)}
    for file in files_below(scene) if missing else ():
        if str(file) not in no_photos and file.suffix.lower() in NAMED_SUFFIXES:
            index[_stem(file.name)].append(file)
    alike = {place: index.get(_stem(names[place]), []) for place in missing}
    said = {place: {PurePosixPath(form).parent for form in _forms(names[place], folders)} for place in missing}
    beside = {place: [file for file in files if file.parent in said[place]] for place, files in alike.items()}
    moved = _distinct(beside, names) or (_distinct(alike, names) if len(missing) == len(found) else {})
    pairs = sorted((path, place) for place, path in (*enumerate(found), *moved.items()) if path)
    absent = [written[place] for place in missing if place not in moved]
    links = (broken_link(scene / form) for name in absent[:1] for form in _forms(name, folders))
    link = next(filter(None, links), "")
    if absent and len(pairs) < FEWEST_PHOTOS:
        lacking = f"{len(absent)} are missing in {scene} ({named(absent)}): at least {FEWEST_PHOTOS} are needed"
        raise InputError(f"{source} names {len(names)} photos, of which {lacking}; {link or 'copy the photos there'}")
    notes = []
    if ways := [(path, written[at]) for at, path in moved.items() if os.path.splitext(path)[0] != written[at]]:
        path, name = ways[0]  # more than the suffix is another
        says = source.name if source == scene else source.relative_to(scene).as_posix()
        notes.append(f"{len(ways)} photos are not where {says} says: {path} is taken for {name}, ...")
    if absent:
        gone = f"{len(absent)} of {len(names)} images are left out, their photos do not exist: {named(absent, most=5)}"
        around = set().union(*said.values())
        near = {scene / file for files in index.values() for file in files if file.parent in around}
        taken = {scene / path for path, _ in pairs}
        free = [path.relative_to(scene).as_posix() for path in sorted(near - taken - {*maps_beside(near | taken)})]
        unused = f"{len(free)} photo{'s are' if free[1:] else ' is'} not used: {named(free, most=5)}" if free else ""
        notes.append("; ".join(filter(None, (gone, link, unused))))
    inner = {path.split("/")[0] if "/" in path else "" for path, _ in pairs}
    folder = scene / inner.pop() if len(inner) == 1 else scene
    shown = tuple((scene / path).relative_to(folder).as_posix() for path, _ in pairs)
    return FoundPhotos(folder, shown, [place for _, place in pairs], notes)


def plain(text: str) -> str:
    """A name in one form of Unicode and small letters."""
    return unicodedata.normalize("NFC", text).lower()


def _stem(name: str) -> str:
    """A photo's name without folders and suffix, in plain letters. What is no suffix of an image is part of it."""
    path = PureWindowsPath(name)
    return plain(path.stem if path.suffix.lower() in (*NAMED_SUFFIXES, *OTHER_SUFFIXES) else path.name)


def _distinct(files: dict[int, list[PurePosixPath]], names: Sequence[str]) -> dict[int, str]:
    """The file that the name of each place stands for, where it is clear which, and no other place's."""
    best = {}
    for place, of_place in files.items():
        path = PureWindowsPath(names[place])
        alike = [file for file in of_place if plain(file.name) == plain(path.name)] or of_place
        ends = [max(n for n in range(1, 1 + len(at.parts)) if at.parts[-n:-1] == path.parts[-n:-1]) for at in alike]
        if ends.count(max(ends, default=0)) == 1:
            best[place] = str(alike[ends.index(max(ends))])
    times = Counter(best.values())
    return {place: path for place, path in best.items() if times[path] == 1}
