"""A COLMAP capture whose photos each have a refined camera of their own, for any trainer that reads principal points.

Cameras and points are refined by `captures.bundle_adjustment`, here from all photos: a trainer that takes
some of them for testing tests with refined cameras, too. One that takes the middle of each photo for its principal
point (3DGS's own, LiteGS) would see the photos shifted, some by many pixels.
"""

from __future__ import annotations

import glob
import os
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.bundle_adjustment import (
    FARTHEST_MATCH,
    Pinholes,
    Refinement,
    farthest_match,
    of_these_photos,
    refine_together,
)
from turbogs_plugin.captures.capture import LARGEST_SIDE, Capture, named
from turbogs_plugin.captures.colmap import (
    incomplete_model,
    load_pycolmap,
    read_colmap,
    read_reconstruction,
    write_whole,
)
from turbogs_plugin.captures.kinds import camera_files, capture_near
from turbogs_plugin.captures.mask_files import FOLDER as MASKS
from turbogs_plugin.captures.photo_files import REDUCED
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable

if TYPE_CHECKING:
    import pycolmap

PHOTOS, MODEL = "images", "sparse"
"""Folders of the new capture."""
UNKNOWN = -1.0
"""COLMAP's own value for the error of a point."""


def write_refined(scene: Path, out: Path) -> str:
    """Write a COLMAP capture with the refined cameras and points of another: ``sparse/0``, and links to its photos.

    Points, colours, features and tracks are those that were read, under the same identifiers. Reduced copies of the
    photos (``images_2``, ...) and masks that lie beside them are linked, too. Where a folder cannot be linked, it is
    copied.

    Args:
        scene: folder of a COLMAP capture.
        out: new or empty folder.

    Returns:
        Lines for the user: what is unusual about the capture, if anything is; how many cameras were refined, with the
        median errors in pixels before and after; where it was written.

    Raises:
        InputError: the capture has no reconstruction or lacks photos; photos show none of its points, or show them
            elsewhere; its cameras have distortion; `out` is not empty, or cannot be written. Then nothing is written.
    """
    load_pycolmap()  # where it is absent, that is said first
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out '{out}' holds something else: choose a new folder")
    require_writable(out, f"--out '{out}'")
    model, suffix = _find(scene)
    capture = read_colmap(scene, model, suffix)
    _require_usable(scene, model, capture, out)
    given, observations = Pinholes.of(capture.viewmats, capture.Ks, capture.sizes), capture.observations
    if not of_these_photos(given, capture.points, observations):
        raise InputError(
            f"{model}: half of its points are more than {farthest_match(given):.1f} pixels ({FARTHEST_MATCH:.0%} of a "
            "photo's width) from where its photos show them: it is of other photos, or was changed since; reconstruct "
            "the photos again"
        )
    refined = refine_together(given, capture.points, observations)
    with _whole(out) as folder:
        _place_photos(scene, capture, out, folder)
        _write(_reconstruction(model, suffix, capture, refined), folder / MODEL / "0", out)
    return "\n".join([*capture.notes[1:], refined.text("cameras"), f"scene  {out}"])


def _find(scene: Path) -> tuple[Path, str]:
    """The reconstruction that `load_scene` reads, and its suffix."""
    if not scene.is_dir():
        trouble = "is a file" if scene.is_file() else "does not exist"
        raise InputError(f"no such scene: {scene} {trouble}: give the folder of a COLMAP capture")
    found, others = camera_files(scene)
    if found:
        return found
    if lack := incomplete_model(scene):
        folder, absent = lack
        raise InputError(f"{folder} has no {' and no '.join(absent)}: bring what it lacks back")
    if not others and (where := capture_near(scene)):
        raise InputError(where)
    raise InputError(
        f"{scene} has no COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0): make one of "
        f"its photos by 'turbogs reconstruct {shlex.quote(str(scene))} --out SCENE', then refine SCENE"
    )


def _require_usable(scene: Path, model: Path, capture: Capture, out: Path) -> None:
    """Raise `InputError` where a capture cannot be refined, or not into `out`."""
    folder, names = capture.photo_folder, capture.names
    if absent := [name for name in names if not (folder / name).is_file()]:
        raise InputError(
            f"{len(absent)} of {len(names)} photos are missing in {folder}: {named(absent)}; bring them back"
        )
    if folder.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(f"--out '{out}' would lie among the photos of '{folder}': choose a folder elsewhere")
    if capture.observations is None or not len(capture.observations):
        raise InputError(
            f"{model} has no points that its photos show, and by these cameras are refined: take a reconstruction as "
            "COLMAP wrote it, with points and tracks"
        )
    if bent := [lens.model for lens in capture.lenses if lens is not None]:
        raise InputError(
            f"{scene}: {len(bent)} of {len(names)} cameras have distortion ({bent[0]}), and refined ones are pinholes: "
            "undistort the capture first by 'colmap image_undistorter', then use what that writes"
        )


def _reconstruction(model: Path, suffix: str, capture: Capture, refined: Refinement) -> pycolmap.Reconstruction:
    """That of a capture, with other cameras and points.

    Args:
        model, suffix: what the capture was read from.
        refined: its cameras, and its points in the order of their identifiers.
    """
    pycolmap = load_pycolmap()
    old, new = read_reconstruction(model, suffix), pycolmap.Reconstruction()
    images = {image.name: image for image in old.images.values() if image.has_pose}
    for view, (name, (width, height)) in enumerate(zip(capture.names, capture.sizes.tolist(), strict=True)):
        number = images[name].image_id  # of the camera, too
        cameras = refined.cameras
        params = [*cameras.focal[view], *cameras.centers[view]]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=width, height=height, params=params)
        new.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(np.c_[cameras.rotations[view], cameras.translations[view]])
        image = pycolmap.Image(name, points2D=images[name].points2D, camera_id=number, image_id=number)
        new.add_image_with_trivial_frame(image, pose)
    kept = {images[name].image_id for name in capture.names}
    left_out = not kept.issuperset(old.images)  # images without a photo or a pose
    for (number, point), place in zip(sorted(old.points3D.items()), refined.points, strict=True):
        point.xyz = place
        if left_out:
            point.track.elements = [element for element in point.track.elements if element.image_id in kept]
        new.add_point3D_with_id(number, point)
    new.update_point_3d_errors()
    for point in new.points3D.values():
        if point.error > LARGEST_SIDE:  # behind a camera that shows it, which counts 1e154 pixels
            point.error = UNKNOWN
    return new


def _write(reconstruction: pycolmap.Reconstruction, folder: Path, out: Path) -> None:
    folder.mkdir(parents=True)
    try:
        write_whole(reconstruction, folder, out)
    except OSError as error:
        raise InputError(f"--out '{out}' cannot be written: make room there, or choose another place") from error


def _place_photos(scene: Path, capture: Capture, out: Path, folder: Path) -> None:
    """Link the capture's photos, their reduced copies and masks.

    Args:
        out: the new capture, for which links are right.
        folder: where they are made.
    """
    near = scene.resolve().parent
    together = near != near.parent and near in out.resolve().parents  # and so likely moved together
    for name, source in _photo_folders(scene, capture).items():
        place = source.resolve()
        if together and near in place.parents:
            place = Path(os.path.relpath(place, out.resolve()))
        try:
            (folder / name).symlink_to(place, target_is_directory=True)
        except OSError:  # a disk without links
            # The photos may lie in the capture itself, beside much else.
            files = capture.names if source == capture.photo_folder else _files(source)
            for file in files:
                (folder / name / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / file, folder / name / file)


def _photo_folders(scene: Path, capture: Capture) -> dict[str, Path]:
    """The folders of a capture beside its reconstruction, by the names that they get."""
    photos, found = capture.photo_folder, {}
    for parent in (photos, photos.parent, scene):  # the last counts, as for `find_masks` the first
        found |= {
            entry.name: entry for entry in parent.glob(f"{MASKS}*") if re.fullmatch(rf"{MASKS}(_\d+)?", entry.name)
        }
    if photos != scene:
        # Where the full-size photos are not there, the photos are such a copy themselves.
        whole = REDUCED.sub("", photos.name) if capture.reduction > 1 else photos.name
        for entry in photos.parent.glob(f"{glob.escape(whole)}_*"):
            ending = entry.name.removeprefix(whole)
            if REDUCED.fullmatch(ending):
                found[f"{PHOTOS}{ending}"] = entry
    if capture.reduction == 1:
        found[PHOTOS] = photos
    return {name: entry for name, entry in found.items() if entry.is_dir()}


def _files(folder: Path) -> list[Path]:
    """Those in a folder and in the folders of it, relative to it."""
    return [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """A folder, all of which comes into `out` at the end; after a failure nothing of it does, nor is `out` made."""
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=out, prefix=".") as temporary:
            folder = Path(temporary)
            yield folder
            for entry in sorted(folder.iterdir(), key=lambda entry: entry.name == MODEL):  # it is what makes a capture
                entry.rename(out / entry.name)
    except BaseException:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()
        raise
