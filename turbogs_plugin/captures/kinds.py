"""Which kind of capture a folder is, and where the capture is that a path beside it was given for."""

from __future__ import annotations

import itertools
import os
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from turbogs_plugin.captures import blender, llff
from turbogs_plugin.captures.capture import Capture, named
from turbogs_plugin.captures.colmap import INSTANT_NGP_FOLDERS, MODEL_FOLDERS, find_model, incomplete_model, read_colmap
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.captures.transforms import FILE, read_transforms
from turbogs_plugin.errors import InputError

POSE_FILES = (FILE, *blender.FILES, llff.FILE)
"""Files of cameras that are not COLMAP's, in the order in which they are taken."""
LEVELS = 2
"""Captures are looked for up to this many folders up and down."""
PARTS_OF_RUN = ("model.ply", "checkpoints", "report")
"""One of these lies beside the config.yaml of a run that has begun."""
LONGEST_CONFIG = 64 * 1024
"""Bytes that are read of a config.yaml; a run's has about three thousand."""


def read_capture(scene: Path, factor: int) -> Capture:
    """The capture in a folder, of the first kind in the order that `load_scene` states.

    Raises:
        InputError: the folder is no capture, with what to do; see also the readers.
    """
    if not scene.is_dir():
        if scene.is_file() and not unread(scene) and (where := capture_around(scene)):
            raise InputError(where)
        trouble = f"{scene} is a file" if scene.is_file() else f"{scene} does not exist"
        raise InputError(f"no such scene: {unread(scene) or f'{trouble}: give the folder of a capture, or of photos'}")
    model, files = camera_files(scene)
    found = _read_model(scene, model, bool(files))
    if isinstance(found, Capture):
        return _passing_over(files, found)
    if not files:
        raise _no_capture(scene)
    if files[0] == FILE:
        other = _passing_over(files[1:], read_transforms(scene))
    elif files[0] in blender.FILES:
        other = _passing_over([file for file in files if file not in blender.FILES], blender.read_blender(scene))
    else:
        other = llff.read_llff(scene, factor)
    return replace(other, notes=(*other.notes, found)) if found else other


def camera_files(scene: Path) -> tuple[tuple[Path, str] | None, list[str]]:
    """What a folder has of cameras: the reconstruction, as `find_model` gives it, and the names of other files."""
    files = [file for file in POSE_FILES if (scene / file).is_file()]
    return find_model(scene, anywhere=not files), files


def holds_photos_alone(scene: Path) -> bool:
    """Whether a folder has photos, and nothing that says where they were taken from: no reconstruction in parts, and no
    capture in it or around it."""
    if not scene.is_dir() or _is_begun(scene) or camera_files(scene) != (None, []):
        return False
    return bool(find_photos(scene)[1]) and not capture_near(scene)


def _is_begun(scene: Path) -> bool:
    """Whether there is a folder for a reconstruction, whatever it has."""
    return any((scene / place.partition("/")[0]).is_dir() for place in MODEL_FOLDERS if place != ".")


def _read_model(scene: Path, model: tuple[Path, str] | None, others: bool) -> Capture | str:
    """The capture of what `find_model` gave, or why that reconstruction is not used; empty where there is none.

    Args:
        others: the folder has files of cameras of other kinds.
    """
    if model is None:
        lack = incomplete_model(scene)
        if lack is None or lack[0] == scene:
            return ""
        return f"{lack[0]} is not used: it has no {' and no '.join(lack[1])}"
    # What instant-ngp leaves beside its transforms.json must serve as well as that.
    whole = others and model[0].relative_to(scene).parts[:1] in [(name,) for name in INSTANT_NGP_FOLDERS]
    try:
        capture = read_colmap(scene, *model)
    except InputError as error:
        if not whole:
            raise
        return f"{model[0]} is not used: {error}"
    there = [(capture.photo_folder / name).is_file() for name in capture.names]
    if not others or (all(there) if whole else any(there)):
        return capture
    # LLFF's poses are of the reduced copies too, which have other names than COLMAP's photos.
    return f"{model[0]} not used, its photos are not there"


def _passing_over(files: list[str], capture: Capture) -> Capture:
    """The capture, whose notes say that these files, which make the folder another kind too, were not used."""
    return replace(capture, notes=(*capture.notes, f"{', '.join(files)} not used")) if files else capture


def _no_capture(scene: Path) -> InputError:
    """What a folder lacks that is no capture."""
    begun, photos, lack = _is_begun(scene), find_photos(scene)[1], incomplete_model(scene)
    if not begun and (where := capture_near(scene)):
        return InputError(where)
    solve = f"find the cameras by 'turbogs reconstruct {shlex.quote(str(scene))} --out SCENE'"
    if photos and not begun:
        trouble = f"{scene} has {len(photos)} photos and nothing that says where they were taken from"
        return InputError(f"{trouble}: {solve}, then use SCENE")
    if lack:
        folder, absent = lack
        anew = f", or delete that folder and {solve}" if photos else ""
        return InputError(f"{folder} has no {' and no '.join(absent)}: bring back what is missing{anew}")
    if photos:
        place = next(scene / place for place in MODEL_FOLDERS if (scene / place).is_dir())
        trouble = f"{scene} has {len(photos)} photos and no reconstruction in {place}"
        return InputError(f"{trouble}: bring its files back, or delete that folder and {solve}")
    return InputError(
        f"{scene} has neither a COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0) nor a "
        f"{FILE}, a {blender.TRAIN_FILE} or a {llff.FILE}, nor photos"
        f"; {unread(scene) or 'give the folder of a capture, or of photos'}"
    )


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
