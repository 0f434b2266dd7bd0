"""Kinds of captures: the one that a folder is."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

from turbogs_plugin.captures import llff, transforms
from turbogs_plugin.captures.capture import Capture
from turbogs_plugin.captures.colmap import find_model, read_colmap
from turbogs_plugin.captures.photo_files import IMAGES, find_photos, unread
from turbogs_plugin.errors import InputError

READERS: dict[str, Callable[[Path], Capture]] = {
    transforms.FILE: transforms.read_transforms,
    transforms.TRAIN_FILE: transforms.read_blender,
    llff.FILE: llff.read_llff,
}
"""Readers of files of cameras that are not COLMAP's, in the order in which they are taken."""
OTHER_POSES = {
    "OpenSfM or ODM: ns-process-data odm, or OpenSfM's export_colmap": ("opensfm/*.json", "reconstruction*.json"),
    "Metashape: export its cameras as COLMAP, or ns-process-data metashape": ("*.xml", "*.psx"),
    "RealityScan: export as COLMAP, or ns-process-data realitycapture": ("*.csv", "*.rspj", "*.rcproj"),
    "Bundler, VisualSFM or Pix4D: export as COLMAP": ("*.out", "*.nvm", "*calibrated*camera*.txt"),
    "openMVG or Meshroom: openMVG_main_openMVG2Colmap, or export as COLMAP": ("sfm_data*", "*.sfm"),
    "Polycam: ns-process-data polycam": ("*cameras/*.json", "keyframes/*cameras", "mesh_info.json"),
    "Record3D: ns-process-data record3d": ("metadata.json", "EXR_RGBD"),
    "a tracker: write its poses into a transforms.json": ("pose*.txt", "*traj*.txt", "groundtruth.txt", "*.pose.txt"),
    "the capture of a model: use that capture": ("cameras.json",),
}
"""Files that may have cameras and are not read, by what writes them and the way from there to a capture."""
SPLITS = ("test.txt", "train.txt", "val.txt", "split.json", "train_test_lists.json", "transforms_test.json")
"""Files of splits, of which readers of other kinds of captures take none."""
PARTS_OF_RUN = ("model.ply", "checkpoints", "report")
"""One of these lies beside the config.yaml of a run that has begun."""


def read_capture(scene: Path) -> Capture:
    """The capture in a folder, of the first kind that can be read, in the order that `load_scene` states.

    Notes say which other kinds are not used, and why where they come before.

    Raises:
        InputError: the folder is no capture, with what to do; or no kind can be read: what the first lacks.
    """
    if not scene.is_dir():
        trouble = f"{scene} is a file" if scene.is_file() else f"{scene} does not exist"
        raise InputError(f"no such scene: {unread(scene) or f'{trouble}: give the folder of a capture, or of photos'}")
    kinds, failed = _kinds(scene), []
    for place, (_, read) in enumerate(kinds):
        try:
            capture = read()
        except InputError as error:
            failed.append(error)
            continue
        splits = (name for name in SPLITS if (scene / name).is_file() and name not in capture.notes[0])
        unused = ", ".join([*(name for name, _ in kinds[place + 1 :]), *splits])
        notes = [*([f"{unused} not used"] if unused else []), *(f"not used: {error}" for error in failed)]
        return replace(capture, notes=(*capture.notes, *notes))
    raise failed[0] if failed else _no_capture(scene)


def _kinds(scene: Path) -> list[tuple[str, Callable[[], Capture]]]:
    """Files or folders of cameras in a folder, in the order in which they are taken: names and readers."""
    model = find_model(scene)
    colmap = [] if model is None else [(str(model[0]), partial(read_colmap, scene, *model))]
    return [*colmap, *((name, partial(read, scene)) for name, read in READERS.items() if (scene / name).is_file())]


def holds_photos_alone(scene: Path) -> bool:
    """True where a folder has photos and nothing that says where they were taken from, neither in it nor around it."""
    return scene.is_dir() and not _kinds(scene) and bool(find_photos(scene)[1]) and not _elsewhere(scene)


def run_folder(folder: Path) -> str:
    """A line where a folder is a run's; empty where it is none."""
    if (folder / "config.yaml").is_file() and any((folder / part).exists() for part in PARTS_OF_RUN):
        return f"{folder} is a run's folder: give the capture that it was trained on, which its config.yaml names"
    return ""


def _elsewhere(folder: Path) -> str:
    """A line where a folder is a run's, or lies in a capture; empty where it is and does neither."""
    around = folder.absolute().parent
    return run_folder(folder) or (f"{folder} lies in the capture {around}: give that folder" if _kinds(around) else "")


def other_poses(folder: Path) -> str:
    """A line on a file of another program's cameras in a folder, or in the one that its ``images`` are of; or empty."""
    for place in (folder, folder.absolute().parent) if folder.absolute().name == IMAGES else (folder,):
        for at, (source, forms) in product(("", "*/"), OTHER_POSES.items()):
            for file in (file for form in forms for file in place.glob(at + form)):
                return f"{file} is not read, which may have cameras of {source}"
    return ""


def _no_capture(scene: Path) -> InputError:
    """The error for a folder that is no capture: what it lacks."""
    if where := _elsewhere(scene):
        return InputError(where)
    poses, call = other_poses(scene), f"'turbogs reconstruct {shlex.quote(str(scene))} --out SCENE'"
    if photos := find_photos(scene)[1]:
        known = f"{poses}; or" if poses else "nothing that says where they were taken from:"
        return InputError(f"{scene} has {len(photos)} photos and {known} find the cameras by {call}, then use SCENE")
    return InputError(
        f"{scene} has neither a COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0) nor a "
        f"{', a '.join(READERS)}, nor photos; "
        + (poses or unread(scene, every=True) or "give the folder of a capture, or of photos")
    )
