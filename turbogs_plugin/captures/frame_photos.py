"""Photos of a transforms.json that lie in another folder than it says."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import reduce
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, named
from turbogs_plugin.captures.photo_files import FOLDER_DEPTH, OTHER_IMAGES
from turbogs_plugin.captures.photo_folder import NO_PHOTOS, PHOTO_SUFFIXES
from turbogs_plugin.errors import InputError


def find_elsewhere(scene: Path, names: Sequence[str], frames: Sequence[dict[str, Any]]) -> tuple[dict[str, str], str]:
    """Look for photos by their file names, in the scene and in folders of it, `FOLDER_DEPTH` deep.

    Of several files of the same name that one counts whose path ends as the photo's does. Suffixes may be others where
    nothing has the same. Masks and other files that frames name are not photos.

    Args:
        names: of the photos, as `photo_name` gives them; none is there.
        frames: of the file.

    Returns:
        The paths relative to the scene of those that were found, by their names; nothing where one name may stand for
        several files, or one file for several names. What to add to a line on missing photos.
    """
    texts = [(key, text) for frame in frames for key, text in frame.items() if isinstance(text, str)]
    others = {PurePosixPath(text) for key, text in texts if key != "file_path"}
    files: dict[str, list[PurePosixPath]] = defaultdict(list)
    for folder, inner, inside in os.walk(scene, followlinks=True):
        place = PurePosixPath(Path(folder).relative_to(scene).as_posix())
        deepest = len(place.parts) == FOLDER_DEPTH
        inner[:] = [] if deepest else sorted(filter(_may_hold_photos, inner))
        for file in sorted(inside):
            if place / file not in others:
                files[file.lower()].append(place / file)
    found: dict[str, str] = {}
    for name in names:
        best = _best(files, PureWindowsPath(name))
        if len(best) > 1:
            return {}, f" ({best[0].name} is in {named([str(scene / file.parent) for file in best])})"
        if best:
            found[name] = str(best[0])
    twice = [file for file, count in Counter(found.values()).items() if count > 1]
    return ({}, f" ({scene / twice[0]} is of several names)") if twice else (found, "")


def _may_hold_photos(folder: str) -> bool:
    return folder.isprintable() and not (NO_PHOTOS.fullmatch(folder) or OTHER_IMAGES.fullmatch(folder))


def _best(files: dict[str, list[PurePosixPath]], name: PureWindowsPath) -> list[PurePosixPath]:
    """The files that a name may stand for; `files` are by their names in small letters."""
    base, stem = name.name.lower(), name.stem.lower()
    numbered = name.suffix[1:].isdigit()  # a number is part of the name
    forms = (
        [base],
        [base + each for each in PHOTO_SUFFIXES],
        [] if numbered else [stem + each for each in PHOTO_SUFFIXES],
    )
    there = next(filter(None, ([file for form in some for file in files.get(form, ())] for some in forms)), [])
    lengths = [len(_shared(file.parts[-2::-1], name.parts[-2::-1])) for file in there]
    return [file for file, length in zip(there, lengths, strict=True) if length == max(lengths)]


def _shared(parts: Sequence[str], others: Sequence[str]) -> list[str]:
    """The first ones, as long as they are equal."""
    return [part for part, _ in takewhile(lambda both: both[0] == both[1], zip(parts, others, strict=False))]


def elsewhere_note(scene: Path, found: dict[str, str]) -> str:
    """What `find_elsewhere` found, in one line."""
    return f"photos in {named(sorted({str(scene / PurePosixPath(file).parent) for file in found.values()}))}"


def require_enough(scene: Path, source: Path, absent: Sequence[str], count: int, unclear: str = "") -> None:
    """Raise `InputError` where photos of a file's `count` frames do not exist and fewer than `FEWEST_PHOTOS` remain.

    Args:
        absent: the names of those.
        unclear: what `find_elsewhere` says of them.
    """
    if absent and count - len(absent) < FEWEST_PHOTOS:
        raise InputError(
            f"{source} names {count} photos, of which {len(absent)} are missing in {_expected_folder(scene, absent)} "
            f"({absent[0]}, ...): at least {FEWEST_PHOTOS} are needed; copy the photos there{unclear}"
        )


def _expected_folder(scene: Path, names: Sequence[str]) -> Path:
    """The folder of the scene in which photos are looked for that are not there."""
    folders = []
    for path in map(PureWindowsPath, names):  # knows both kinds of separators, drives and roots
        leaves = path.anchor or ".." in path.parts
        folders.append([each for each in path.parts[-2 if leaves else 0 : -1] if each not in ("..", path.anchor)])
    return scene.joinpath(*reduce(_shared, folders))
