"""Captures in a folder and around it: where the capture is, that a path beside it was given for."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from turbogs_plugin.captures import blender, llff
from turbogs_plugin.captures.capture import named
from turbogs_plugin.captures.colmap import find_model
from turbogs_plugin.captures.photo_folder import find_photos
from turbogs_plugin.captures.transforms import FILE

LEVELS = 2
"""Captures are looked for so many folders up and down."""
POSE_FILES = (FILE, *blender.FILES, llff.FILE)
PARTS_OF_RUN = ("model.ply", "checkpoints", "report")
"""One of them lies beside the config.yaml of a run that has begun."""
LONGEST_CONFIG = 64 * 1024
"""Bytes that are read of it; those of a run have about three thousand."""


def capture_near(folder: Path) -> str:
    """A line that names the captures in a folder, else the one that the folder lies in, or that it is a run on; empty
    where there are none.

    Where the folder has photos of its own, captures that were reconstructed from photos do not count.
    """
    if where := capture_of_run(folder):
        return where
    inner = _captures_in(folder, LEVELS)
    if find_photos(folder)[1]:
        inner = ((place, mark) for place, mark in inner if not (place / "reconstruction").is_dir())
    if not (found := list(itertools.islice(inner, 4))):
        return capture_around(folder)
    remedy = "give that folder" if len(found) == 1 else "give one of these folders"
    return f"{named([f'{place} has a {mark}' for place, mark in found])}: {remedy}"


def capture_of_run(folder: Path) -> str:
    """A line that names the capture that a run was trained on, whose folder this is; empty where it is none."""
    config = folder / "config.yaml"
    if not (config.is_file() and any((folder / part).exists() for part in PARTS_OF_RUN)):
        return ""
    import yaml  # a capture is read without it

    try:
        with open(config, "rb") as file:
            capture = yaml.safe_load(file.read(LONGEST_CONFIG))["scene"]["path"]
    except (OSError, ValueError, yaml.YAMLError, RecursionError, KeyError, TypeError):  # another program's
        return ""
    return f"{folder} is a run's folder, not a capture: give {capture}, which it was trained on"


def capture_around(path: Path) -> str:
    """A line that names the capture that a file or folder lies in; empty where it lies in none, or is one itself."""
    if path.is_dir() and _mark(path):
        return ""
    absolute = Path(os.path.abspath(path))
    shown = {Path(os.path.abspath(parent)): parent for parent in path.parents}  # as the user wrote them
    above = [shown.get(parent, parent) for parent in absolute.parents[: LEVELS + path.is_file()]]
    # Beside colmap/sparse the photos are one folder up: that is the capture.
    marked = sorted((parent for parent in above if _mark(parent)), key=lambda parent: not find_photos(parent)[1])
    if not marked:
        return ""
    by = marked[0] / _mark(marked[0])
    return f"{path} lies in the capture {marked[0]}{'' if by == path else f' ({by})'}: give that folder"


def _captures_in(folder: Path, depth: int) -> Iterator[tuple[Path, str]]:
    """The captures in a folder, and what marks each; those in captures are left out."""
    try:
        inner = sorted(entry.name for entry in os.scandir(folder) if entry.name[0] != "." and entry.is_dir())
    except OSError:
        return
    for place in (folder / name for name in inner):
        if mark := _mark(place):
            yield place, mark
        elif depth > 1:
            yield from _captures_in(place, depth - 1)


def _mark(folder: Path) -> str:
    """What makes a folder a capture: ``sparse/0`` or the name of a file; empty for other folders.

    A reconstruction in the very folder, or in numbered ones of it, does not: it is a part of a capture.
    """
    try:
        model = find_model(folder)
        place = model[0].relative_to(folder) if model else Path()
        if place.parts and not place.parts[0].isdigit():
            return place.as_posix()
        return next((file for file in POSE_FILES if (folder / file).is_file()), "")
    except OSError:  # a folder that may not be read
        return ""
