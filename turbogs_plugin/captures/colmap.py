"""COLMAP reconstructions: which one of a folder is read, and what becomes of it."""

from __future__ import annotations

import errno
import itertools
import re
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, LARGEST_SIDE, Capture, check_photo_name, left_out, named
from turbogs_plugin.captures.colmap_files import (
    FILES,
    NO_POINT,
    SUFFIXES,
    ColmapModel,
    ModelImage,
    count_images,
    read_model,
    read_poses,
)
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.photo_files import FOLDER_DEPTH, find_photo_folder, folders_in
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.undistort import Lens, lens_of_camera
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.scene import Observations

if TYPE_CHECKING:
    import pycolmap

MODEL_FOLDERS = ("sparse", "colmap/sparse", "colmap", ".")
"""Where a scene's reconstructions may lie, in order of preference: there, or in numbered folders of it."""
INSTANT_NGP_FOLDERS = ("colmap_sparse", "colmap_text")
"""Further ones, of instant-ngp's ``colmap2nerf.py``."""
STRAIGHT_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models that are a pinhole where all their parameters of distortion are 0."""


def load_pycolmap() -> ModuleType:
    """The module, loaded where it is used: other kinds of captures need neither its time nor its presence.

    SIGTERM keeps the handler that Python knows of: pycolmap brings one that prints a trace of C++.
    """
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


def find_model(scene: Path, anywhere: bool = False) -> tuple[Path, str] | None:
    """The scene's reconstruction and its suffix, '.bin' or '.txt'; None where there is none.

    Of the several that COLMAP writes where photos did not connect (``sparse/0``, ``sparse/1``, ...), the one with most
    images is taken.

    Args:
        anywhere: where there is none in the known folders, look at folders of any name, `FOLDER_DEPTH` deep.
    """
    elsewhere = folders_in(scene, FOLDER_DEPTH) if anywhere else ()
    for place in itertools.chain(_known_folders(scene), elsewhere):
        if numbered := _numbered_models(place):
            return max(numbered, key=lambda model: _count(*model))  # the first of equals
        if suffix := _suffix(place):
            return place, suffix
    return None


def incomplete_model(scene: Path) -> tuple[Path, list[str]] | None:
    """Where a reconstruction lies that lacks files, and which: for the suffix that has most; None: there is none."""
    for place in _known_folders(scene):
        for folder in (place, *sorted(place.glob("[0-9]"))):
            absent = [
                [file for name in FILES if not (folder / (file := f"{name}{suffix}")).is_file()] for suffix in SUFFIXES
            ]
            if any(len(files) < len(FILES) for files in absent):
                return folder, min(absent, key=len)
    return None


def _known_folders(scene: Path) -> list[Path]:
    return [scene / name for name in (*MODEL_FOLDERS, *INSTANT_NGP_FOLDERS)]


def _suffix(folder: Path) -> str:
    """The suffix of the reconstruction in this very folder; empty where there is none."""
    complete = (suffix for suffix in SUFFIXES if all((folder / f"{file}{suffix}").is_file() for file in FILES))
    return next(complete, "")


def _numbered_models(place: Path) -> list[tuple[Path, str]]:
    """The reconstructions in ``place/0``, ``place/1``, ..., in order of their numbers."""
    folders = [folder for folder in place.glob("[0-9]*") if re.fullmatch("[0-9]{1,9}", folder.name)]
    folders.sort(key=lambda folder: (int(folder.name), folder.name))
    return [(folder, suffix) for folder in folders if (suffix := _suffix(folder))]


def _count(model: Path, suffix: str) -> int:
    return count_images(model / f"images{suffix}")


def read_colmap(scene: Path, folder: Path, suffix: str) -> Capture:
    """Read a reconstruction. Its photos are found by `find_photo_folder`; images whose photo does not exist are left
    out, where `FEWEST_PHOTOS` remain. Without points, random ones are drawn.

    Args:
        scene: the scene's folder.
        folder, suffix: as `find_model` gives them.

    Raises:
        InputError: files that are damaged or inconsistent, or a camera that no pinhole can take the place of.
    """
    load_pycolmap()
    model = read_model(folder, suffix)
    photos = {image.number: check_photo_name(image.name, folder) for image in model.images}
    images = sorted(model.images, key=lambda image: photos[image.number])
    names = tuple(photos[image.number] for image in images)
    for name, following in itertools.pairwise(names):
        if name == following:
            raise InputError(f"{folder} has two images named '{name}': rename the photos and reconstruct again")
    cameras = [model.cameras[image.camera] for image in images]
    photo_folder, reduction = find_photo_folder(
        scene, {name: (camera.width, camera.height) for name, camera in zip(names, cameras, strict=True)}
    )
    there = [(photo_folder / name).is_file() for name in names]
    absent = [name for name, found in zip(names, there, strict=True) if not found]
    absence = [left_out(absent, len(names), "images")] if absent and sum(there) >= FEWEST_PHOTOS else []
    if absence:
        images, cameras = list(itertools.compress(images, there)), list(itertools.compress(cameras, there))
        names = tuple(itertools.compress(names, there))
    made: dict[tuple, Lens] = {}
    lenses = {image.camera: _lens(model.cameras[image.camera], folder, made) for image in images}
    lens_of_view = tuple(lenses[image.camera] for image in images)
    poses = read_poses(folder, suffix, model)
    viewmats = np.array([poses[image.number] for image in images]).reshape(-1, 4, 4)
    pairs = list(zip(cameras, lens_of_view, strict=True))
    intrinsics = np.array([camera.calibration_matrix() if lens is None else lens.K for camera, lens in pairs])
    sizes = np.array([(camera.width, camera.height) if lens is None else lens.size for camera, lens in pairs])
    intrinsics, sizes = intrinsics.reshape(-1, 3, 3), sizes.reshape(-1, 2).astype(np.int64)
    first = photo_folder / next(iter(names), "")
    if reduction > 1 and first.is_file() and 1.5 * photo_size(first)[0] > cameras[0].width:
        reduction = 1  # the cameras are those of the copies
    points, colors = model.points["xyz"].copy(), model.points["color"].copy()
    shown = f"{len(points):,} points"
    drawn = not len(points) and bool(images)
    if drawn:
        points, how = starting_points(viewmats, intrinsics, sizes)
        shown = f"no points, so {len(points):,} random ones {how}"
    return Capture(
        names=names,
        photo_folder=photo_folder,
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=points,
        point_colors=None if drawn else colors,
        lenses=lens_of_view,
        notes=(
            _kind_note(scene, folder, suffix, len(images), shown, photo_folder),
            *_choice_note(folder),
            *_others_note(scene, folder),
            *absence,
        ),
        reduction=reduction,
        alpha="mask",
        observations=None if drawn else _observations(model, images, lenses),
    ).checked(folder)


def _lens(camera: pycolmap.Camera, model: Path, made: dict[tuple, Lens]) -> Lens | None:
    """None for a pinhole camera, and for one of an impossible size, which `Capture.check` refuses.

    Args:
        made: the lenses so far, by their numbers; a new one is added.
    """
    name, size = camera.model.name, (camera.width, camera.height)
    if name in ("PINHOLE", "SIMPLE_PINHOLE") or not 0 < max(size) <= LARGEST_SIDE:
        return None
    if name in STRAIGHT_MODELS and not camera.params[list(camera.extra_params_idxs())].any():
        return None
    key = (name, size, *camera.params.tolist())
    if key not in made:
        made[key] = lens_of_camera(camera, f"camera {camera.camera_id} of {model}")
    return made[key]


def _observations(model: ColmapModel, images: Sequence[ModelImage], lenses: dict[int, Lens | None]) -> Observations:
    """Where images show points, in pixels of their pinhole cameras.

    Features whose point is not there are left out.

    Args:
        images: the views, in their order.
        lenses: camera's identifier -> its lens; None for a pinhole.
    """
    ids = model.points["id"]
    parts = [(np.zeros((0, 2)), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    for view, image in enumerate(images):
        shown = image.features[image.features["point"] != NO_POINT]
        points = np.searchsorted(ids, shown["point"])
        pixels, lens = shown["pixel"].astype(np.float64), lenses[image.camera]
        if lens is not None and len(pixels):
            pixels = model.cameras[image.camera].cam_from_img(pixels) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
        known = np.isfinite(pixels).all(axis=1) & (ids[points.clip(max=len(ids) - 1)] == shown["point"])
        parts.append((pixels[known], np.full(known.sum(), view), points[known]))
    return Observations(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def read_reconstruction(folder: Path, suffix: str) -> pycolmap.Reconstruction:
    """The reconstruction as pycolmap reads it, with names that `check_photo_name` gave.

    Raises:
        InputError: pycolmap cannot read it, or a name is refused.
    """
    reconstruction = load_pycolmap().Reconstruction()
    try:
        (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(folder)
    except Exception as error:  # pycolmap raises whatever C++ threw
        raise InputError(f"{folder}: pycolmap cannot read this reconstruction; copy or reconstruct it again") from error
    for image in read_model(folder, suffix).images:  # pycolmap cuts a name in text at its first space
        if image.number in reconstruction.images:
            reconstruction.images[image.number].name = check_photo_name(image.name, folder)
    return reconstruction


def write_whole(reconstruction: pycolmap.Reconstruction, folder: Path, called: Path) -> None:
    """Write the binary files of a reconstruction, and see that they are whole: of a full disk pycolmap says nothing.

    Args:
        called: the folder's name in the message.

    Raises:
        OSError: the files are not whole.
    """
    try:
        reconstruction.write_binary(folder)
        read_model(folder, ".bin")
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.ENOSPC, "it cannot be written whole", str(called)) from error


def _kind_note(scene: Path, model: Path, suffix: str, images: int, points: str, photo_folder: Path) -> str:
    kind = {".bin": "binary", ".txt": "text"}[suffix]
    where = "" if photo_folder == scene / "images" else f", photos in {photo_folder}"
    return f"COLMAP reconstruction {model} ({kind}): {images} images, {points}{where}"


def _choice_note(model: Path) -> list[str]:
    """Which of several reconstructions was taken, where there are several."""
    models = _numbered_models(model.parent)
    if len(models) < 2 or model not in [folder for folder, _ in models]:
        return []
    counts = named([f"{folder.name} has {_count(folder, suffix)}" for folder, suffix in models], most=4)
    return [f"{len(models)} reconstructions in {model.parent}: {model.name} is taken for most images ({counts})"]


def _others_note(scene: Path, model: Path) -> list[str]:
    """Which other reconstructions a folder has, where this one is in none of the known folders."""
    if {model, model.parent} & set(_known_folders(scene)):
        return []
    others: list[Path] = []
    for place in folders_in(scene, FOLDER_DEPTH):
        part = {place, place.parent} & {model, model.parent, *others}
        if not part and (_suffix(place) or _numbered_models(place)):
            others.append(place)
    return [f"{named(list(map(str, others)))} not used: give the folder of the capture that you want"] if others else []
