"""COLMAP reconstructions, binary or text, read through pycolmap."""

from __future__ import annotations

import itertools
import re
import signal
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, LARGEST_SIDE, Capture, check_photo_name, left_out, named
from turbogs_plugin.captures.colmap_check import SMALLEST_IMAGE, check_binary_model, read_points
from turbogs_plugin.captures.colmap_tracks import read_observations
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.photo_folder import NO_PHOTOS
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.undistort import Lens, lens_of_camera
from turbogs_plugin.errors import InputError

if TYPE_CHECKING:
    import pycolmap

MODEL_FOLDERS = ("sparse", "colmap/sparse", "colmap", ".")
"""Where a scene's reconstructions may lie, in order of preference: there, or in numbered folders of it."""
INSTANT_NGP_FOLDERS = ("colmap_sparse", "colmap_text")
"""Further ones, of instant-ngp's ``colmap2nerf.py``."""

STRAIGHT_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models that are a pinhole where all their parameters of distortion are 0."""

FILES, SUFFIXES = ("cameras", "images", "points3D"), (".bin", ".txt")

ORIGINALS = "input"
"""Where gaussian-splatting's ``convert.py`` keeps the photos that it undistorts into ``images``."""
REDUCED = re.compile(r"_\d+$")
OTHER_IMAGES = re.compile(r"(depth|normal|semantic|segmentation|confidence)s?|.*[_-]masks?", re.IGNORECASE)
"""Folders of images that have the photos' names and are none."""
FOLDER_DEPTH = 2
"""Photos and models are looked for in folders of folders, no deeper."""
REDUCTIONS = (2, 4, 8, 16)


def load_pycolmap() -> ModuleType:
    """The module: other kinds of captures need neither its time to load nor its presence.

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
        anywhere: where there is none in the known folders, look at those of any name, `FOLDER_DEPTH` deep.
    """
    elsewhere = _folders(scene, FOLDER_DEPTH) if anywhere else ()
    for place in itertools.chain((scene / name for name in (*MODEL_FOLDERS, *INSTANT_NGP_FOLDERS)), elsewhere):
        if numbered := _numbered_models(place):
            return max(numbered, key=lambda model: _count_images(*model))  # the first of equals
        if suffix := _suffix(place):
            return place, suffix
    return None


def _suffix(folder: Path) -> str:
    """That of the reconstruction in this very folder; empty where there is none."""
    complete = (suffix for suffix in SUFFIXES if all((folder / f"{file}{suffix}").is_file() for file in FILES))
    return next(complete, "")


def incomplete_model(scene: Path) -> tuple[Path, list[str]] | None:
    """Of a reconstruction in the known folders that lacks files, where it is and which: those of the suffix that most
    have; None where there is none."""
    for place in (scene / name for name in (*MODEL_FOLDERS, *INSTANT_NGP_FOLDERS)):
        for folder in (place, *sorted(place.glob("[0-9]"))):
            absent = [
                [file for name in FILES if not (folder / (file := f"{name}{suffix}")).is_file()] for suffix in SUFFIXES
            ]
            if any(len(files) < len(FILES) for files in absent):
                return folder, min(absent, key=len)
    return None


def _numbered_models(place: Path) -> list[tuple[Path, str]]:
    """The reconstructions in ``place/0``, ``place/1``, ..., in order of their numbers."""
    folders = [folder for folder in place.glob("[0-9]*") if re.fullmatch("[0-9]{1,9}", folder.name)]
    folders.sort(key=lambda folder: (int(folder.name), folder.name))
    return [(folder, suffix) for folder in folders if (suffix := _suffix(folder))]


def _count_images(model: Path, suffix: str) -> int:
    """Images with a pose, as the file says; damage is left to `read_colmap`."""
    path = model / f"images{suffix}"
    try:
        if suffix == ".bin":
            with path.open("rb") as file:
                announced = int.from_bytes(file.read(8), "little")
            return min(announced, path.stat().st_size // SMALLEST_IMAGE)
        return sum(1 for _ in _lines_of_images(path))
    except OSError:
        return 0


def _lines_of_images(path: Path) -> Iterator[bytes]:
    """The line of each image in an ``images.txt``, in which pycolmap sees one too."""
    with path.open("rb") as file:
        for line in file:
            if (line := line.strip()) and not line.startswith(b"#"):
                yield line
                next(file, None)  # its points: this line may be empty


def _names_of_images(path: Path) -> dict[int, str]:
    """The names in an ``images.txt``, by the images' identifiers. What is not UTF-8 in them cannot be printed."""
    names: dict[int, str] = {}
    for line in _lines_of_images(path):
        fields = line.split(b" ", 9)  # identifier, rotation, translation, camera, name: the rest, with its spaces
        with suppress(ValueError, IndexError):  # no number, no name: then the image has none
            names[int(fields[0])] = fields[9].decode(errors="surrogateescape")
    return names


def read_colmap(scene: Path, model: Path, suffix: str) -> Capture:
    """Read a reconstruction. Its photos are found by `find_photo_folder`; images whose photo does not exist are left
    out, where `FEWEST_PHOTOS` remain. Without points, random ones are drawn.

    Args:
        scene: the scene's folder.
        model, suffix: as `find_model` gives them.

    Raises:
        InputError: files that are damaged or inconsistent, or a camera that no pinhole can take the place of.
    """
    found = check_binary_model(model) if suffix == ".bin" else None
    reconstruction = read_reconstruction(model, suffix)
    images = [image for image in reconstruction.images.values() if image.has_pose]
    images.sort(key=lambda image: image.name)
    names = tuple(image.name for image in images)
    for name, following in itertools.pairwise(names):
        if name == following:
            raise InputError(f"{model} has two images named '{name}': rename the photos and reconstruct again")
    cameras = {image.name: reconstruction.cameras[image.camera_id] for image in images}
    photo_folder, reduction = find_photo_folder(
        scene, {name: (camera.width, camera.height) for name, camera in cameras.items()}
    )
    absent = [name for name in names if not (photo_folder / name).is_file()]
    absence = ()
    if absent and len(names) - len(absent) >= FEWEST_PHOTOS:
        absence = (left_out(absent, len(names), "images"),)
        gone = set(absent)
        images = [image for image in images if image.name not in gone]
        names = tuple(image.name for image in images)
    viewmats = np.tile(np.eye(4), (len(images), 1, 1))
    intrinsics = np.tile(np.eye(3), (len(images), 1, 1))
    sizes = np.zeros((len(images), 2), dtype=np.int64)
    made: dict[tuple, Lens] = {}
    lenses = {image.camera_id: _lens(reconstruction.cameras[image.camera_id], model, made) for image in images}
    for i, image in enumerate(images):
        camera, lens = reconstruction.cameras[image.camera_id], lenses[image.camera_id]
        viewmats[i, :3] = image.cam_from_world().matrix()
        intrinsics[i] = camera.calibration_matrix() if lens is None else lens.K
        sizes[i] = (min(camera.width, 2**31), min(camera.height, 2**31)) if lens is None else lens.size

    if (
        reduction > 1
        and names[0] not in absent
        and 1.5 * photo_size(photo_folder / names[0])[0] > reconstruction.cameras[images[0].camera_id].width
    ):
        reduction = 1  # the cameras are those of the copies
    with nullcontext(model) if suffix == ".bin" else _in_binary(reconstruction) as folder:
        found = read_points(folder / "points3D.bin") if found is None else found
        found = found[np.argsort(found["id"])]
        file, called = folder / "images.bin", model / f"images{suffix}"
        observations = None
        if len(found):
            observations = read_observations(reconstruction, file, images, lenses, found["id"], called)
    points = found["xyz"].copy()
    shown = f"{len(points):,} points"
    if not len(points) and images and np.isfinite(viewmats).all():
        points, how = starting_points(viewmats, intrinsics, sizes)
        shown = f"no points, so {len(points):,} random ones {how}"
    return Capture(
        names=names,
        photo_folder=photo_folder,
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=points,
        point_colors=found["color"].copy() if len(found) else None,
        lenses=tuple(lenses[image.camera_id] for image in images),
        notes=(
            _kind_note(scene, model, suffix, len(images), shown, photo_folder),
            *_choice_note(model),
            *_others_note(scene, model),
            *absence,
        ),
        reduction=reduction,
        alpha="mask",
        observations=observations,
    ).checked(model)


def read_reconstruction(model: Path, suffix: str) -> pycolmap.Reconstruction:
    """What pycolmap reads, whose images with a pose have names that `check_photo_name` gave.

    Raises:
        InputError: pycolmap cannot read it, or such a name is refused.
    """
    reconstruction = load_pycolmap().Reconstruction()
    try:
        (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(model)
    except Exception as error:  # pycolmap raises whatever C++ threw
        reason = " ".join(str(error).split())[:200]
        if "Check failed" in reason:  # with some C++
            reason = "pycolmap cannot read a part of it"
        raise InputError(f"{model} is not a COLMAP reconstruction: {reason}; copy or reconstruct it again") from error
    # Of text pycolmap cuts a name at its first space, and fails where one is not UTF-8.
    names = None if suffix == ".bin" else _names_of_images(model / "images.txt")
    for number, image in reconstruction.images.items():
        if not image.has_pose:
            continue
        if names is not None and number not in names:
            file = model / "images.txt"
            raise InputError(f"{file} is damaged: image {number} has no name; copy or reconstruct it again")
        image.name = check_photo_name(image.name if names is None else names[number], model)
    return reconstruction


@contextmanager
def _in_binary(reconstruction: pycolmap.Reconstruction) -> Iterator[Path]:
    """A folder with a reconstruction's binary files, while entered."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        yield Path(folder)


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
    whole = ((folder, 1) for place in places for folder in _folders(place, FOLDER_DEPTH, of_photos=True))
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


def _folders(place: Path, depth: int, of_photos: bool = False) -> Iterator[Path]:
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


def _kind_note(scene: Path, model: Path, suffix: str, images: int, points: str, photo_folder: Path) -> str:
    kind = {".bin": "binary", ".txt": "text"}[suffix]
    where = "" if photo_folder == scene / "images" else f", photos in {photo_folder}"
    return f"COLMAP reconstruction {model} ({kind}): {images} images, {points}{where}"


def _choice_note(model: Path) -> list[str]:
    """Which of several reconstructions was taken, where there are several."""
    models = _numbered_models(model.parent)
    if len(models) < 2 or model not in [folder for folder, _ in models]:
        return []
    counts = named([f"{folder.name} has {_count_images(folder, suffix)}" for folder, suffix in models], most=4)
    return [f"{len(models)} reconstructions in {model.parent}: {model.name} is taken for most images ({counts})"]


def _others_note(scene: Path, model: Path) -> list[str]:
    """Which other reconstructions a folder has, where this one is in none of the known folders."""
    if {model, model.parent} & {scene / name for name in (*MODEL_FOLDERS, *INSTANT_NGP_FOLDERS)}:
        return []
    others: list[Path] = []
    for place in _folders(scene, FOLDER_DEPTH):
        part = {place, place.parent} & {model, model.parent, *others}
        if not part and (_suffix(place) or _numbered_models(place)):
            others.append(place)
    return [f"{named(list(map(str, others)))} not used: give the folder of the capture that you want"] if others else []
