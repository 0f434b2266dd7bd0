"""Kinds of captures: the one that a folder is, and the capture near a path that is none."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from turbogs_plugin.captures import llff, transforms
from turbogs_plugin.captures.capture import Capture, named
from turbogs_plugin.captures.colmap import find_model, read_colmap
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.errors import InputError

READERS: dict[str, Callable[[Path], Capture]] = {
    transforms.FILE: transforms.read_transforms,
    transforms.TRAIN_FILE: transforms.read_blender,
    llff.FILE: llff.read_llff,
}
"""Readers of files of cameras that are not COLMAP's, in the order in which they are taken."""
LEVELS = 2
"""Captures are looked for up to this many folders up and down."""
PARTS_OF_RUN = ("model.ply", "checkpoints", "report")
"""One of these lies beside the config.yaml of a run that has begun."""


def read_capture(scene: Path) -> Capture:
    """The capture in a folder, of the first kind that can be read, in the order that `load_scene` states.

    Notes say which other kinds are not used, and why where they come before.

    Raises:
        InputError: the folder is no capture, with what to do; or no kind can be read: what the first lacks.
    """
    if not scene.is_dir():
        if scene.is_file() and not unread(scene) and (where := capture_near(scene)):
            raise InputError(where)
        trouble = f"{scene} is a file" if scene.is_file() else f"{scene} does not exist"
        raise InputError(f"no such scene: {unread(scene) or f'{trouble}: give the folder of a capture, or of photos'}")
    kinds, failed = _kinds(scene), []
    for place, (_, read) in enumerate(kinds):
        try:
            capture = read()
        except InputError as error:
            failed.append(error)
            continue
        unused = ", ".join(name for name, _ in kinds[place + 1 :])
        notes = [*([f"{unused} not used"] if unused else []), *(f"not used: {error}" for error in failed)]
        return replace(capture, notes=(*capture.notes, *notes))
    if where := capture_near(scene):
        raise InputError(where)
    raise failed[0] if failed else _no_capture(scene)


def _kinds(scene: Path) -> list[tuple[str, Callable[[], Capture]]]:
    """Files or folders of cameras in a folder, in the order in which they are taken: names and readers."""
    model = find_model(scene)
    colmap = [] if model is None else [(str(model[0]), partial(read_colmap, scene, *model))]
    return [*colmap, *((name, partial(read, scene)) for name, read in READERS.items() if (scene / name).is_file())]


def holds_photos_alone(scene: Path) -> bool:
    """True where a folder has photos and nothing that says where they were taken from: no file of cameras, no capture
    in it or around it."""
    return scene.is_dir() and not _kinds(scene) and bool(find_photos(scene)[1]) and not capture_near(scene)


def _no_capture(scene: Path) -> InputError:
    """The error for a folder that is no capture: what it lacks."""
    if photos := find_photos(scene)[1]:
        return InputError(
            f"{scene} has {len(photos)} photos and nothing that says where they were taken from: find the cameras by "
            f"'turbogs reconstruct {shlex.quote(str(scene))} --out SCENE', then use SCENE"
        )
    return InputError(
        f"{scene} has neither a COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0) nor a "
        f"{', a '.join(READERS)}, nor photos; {unread(scene) or 'give the folder of a capture, or of photos'}"
    )


def capture_near(path: Path) -> str:
    """A line that names the captures in a folder, else the one that a file or folder lies in, or that it is a run's;
    empty where there are none, or where the folder is a capture itself.

    Captures that `turbogs reconstruct` made do not count: they may lie in the folder of their photos.
    """
    if where := run_folder(path):
        return where
    if _mark(path):
        return ""
    inner = [folder for folder in _folders(path, LEVELS) if _mark(folder) and not (folder / "reconstruction").is_dir()]
    if inner:
        captures = named([f"{folder} has a {_mark(folder)}" for folder in inner])
        return f"{captures}: give {'that folder' if len(inner) == 1 else 'one of these folders'}"
    parents = path.absolute().parents[: LEVELS + path.is_file()]
    around = next((folder for folder in parents if _mark(folder)), None)
    return f"{path} lies in the capture {around} ({_mark(around)}): give that folder" if around else ""


def run_folder(folder: Path) -> str:
    """A line where a folder is a run's; empty where it is none."""
    if not ((folder / "config.yaml").is_file() and any((folder / part).exists() for part in PARTS_OF_RUN)):
        return ""
    return f"{folder} is a run's folder: give the capture that it was trained on, which its config.yaml names"


def _folders(folder: Path, depth: int) -> Iterator[Path]:
    """The folders in a folder, in order; not hidden ones, and not those in captures."""
    try:
        inner = sorted(entry for entry in folder.iterdir() if entry.name[0] != "." and entry.is_dir())
    except OSError:  # a file, or a folder that may not be read
        return
    for entry in inner:
        yield entry
        if depth > 1 and not _mark(entry):
            yield from _folders(entry, depth - 1)


def _mark(folder: Path) -> str:
    """The mark of a capture in a folder, ``sparse/0`` or the name of a file; empty for other folders.

    A reconstruction in the very folder, or in numbered ones of it, does not: it is a part of a capture.
    """
    try:
        model = find_model(folder)
        place = model[0].relative_to(folder) if model else Path()
        if place.parts and not place.parts[0].isdigit():
            return place.as_posix()
        return next((file for file in READERS if (folder / file).is_file()), "")
    except OSError:  # a folder that may not be read
        return ""
