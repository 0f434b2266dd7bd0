"""NeRF-synthetic captures: ``transforms_train.json`` and its like, as Blender's exporters write them.

Cameras are in OpenGL's axes (x right, y up, z backward), photos are named without a suffix and are often transparent.
Training and test photos are told apart by file, and the validation photos are not used where there are test photos.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import Capture, left_out, sizes_text
from turbogs_plugin.captures.decoding import is_transparent, opened_image, photo_size
from turbogs_plugin.captures.frame_photos import require_enough
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.transforms import (
    is_there,
    number_of,
    opengl_viewmat,
    other_suffixes,
    other_suffixes_note,
    photo_name,
    pinhole,
    read_camera,
    read_frames,
)
from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.errors import InputError

TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""The first of them that is there names the test photos."""
FILES = (TRAIN_FILE, *TEST_FILES)
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


View = tuple[np.ndarray, np.ndarray, tuple[int, int], Lens | None]
"""A photo's camera: [4, 4] float64 world to camera (x right, y down, z forward); [3, 3] float64 intrinsics and (width,
height), undistorted where there is a lens; the lens."""


def read_blender(scene: Path) -> Capture:
    """Read a capture with the split that its files say.

    Frames whose photo does not exist are left out. Where there are no test photos, the split is left to the order of
    the photos. There are no points: random ones are drawn (`starting_points`) about what the training cameras look at.

    Raises:
        InputError: a file that is not such JSON or lacks something, fewer than `FEWEST_PHOTOS` training photos, or one
            photo in both files.
    """
    if not (scene / TRAIN_FILE).is_file():
        raise InputError(f"{scene} has no {TRAIN_FILE}, which names the photos to train on: bring it back")
    notes: list[str] = []
    lenses: dict[tuple, Lens] = {}
    train, absent = _read_views(scene, scene / TRAIN_FILE, notes, lenses)
    require_enough(scene, scene / TRAIN_FILE, absent, len(train) + len(absent))
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    test, absent_tests = ({}, []) if test_file is None else _read_views(scene, test_file, notes, lenses)
    if absent := [*absent, *absent_tests]:
        notes.append(left_out(absent, len(train) + len(test) + len(absent), "frames"))
    if in_both := sorted(train.keys() & test.keys()):
        raise InputError(
            f"{scene}: {len(in_both)} photos stand both in {TRAIN_FILE} and in {test_file.name} ({in_both[0]}): take "
            f"them out of one; without {' and '.join(TEST_FILES)} every 8th photo is for testing"
        )
    names, views = zip(*sorted({**train, **test}.items()), strict=True)
    viewmats, Ks, sizes, lens_of_view = zip(*views, strict=True)
    train_viewmats, train_Ks, train_sizes, _ = zip(*train.values(), strict=True)
    points, how = starting_points(np.array(train_viewmats), np.array(train_Ks), np.array(train_sizes))
    capture = Capture(
        names=names,
        photo_folder=scene,
        viewmats=np.array(viewmats),
        Ks=np.array(Ks),
        sizes=np.array(sizes),
        points=points,
        lenses=lens_of_view,
        test=np.array([name in test for name in names]) if test else None,
    ).checked(scene / TRAIN_FILE)
    files = f"{scene / TRAIN_FILE}{f' and {test_file.name}' if test_file else ''}"
    drawn = f"{len(points):,} random ones (seed 0) {how}"
    note = f"{files} (NeRF-synthetic): {_note(scene, train, test, capture.photo_sizes, drawn)}"
    return replace(capture, notes=(note, *notes))


def _read_views(
    scene: Path, source: Path, notes: list[str], lenses: dict[tuple, Lens]
) -> tuple[dict[str, View], list[str]]:
    """The views of one file, by the photos' paths relative to the scene, and such paths of photos that do not exist;
    `notes` gets lines for the user, `lenses` new ones by their numbers."""
    content, frames = read_frames(source)
    shared = {key: value for key, value in content.items() if key != "frames"}
    frame_of: dict[str, dict[str, Any]] = {}
    names = [photo_name(scene, frame.get("file_path"), source) for frame in frames]
    if others := other_suffixes(scene, names, source):
        notes.append(other_suffixes_note(others, source))
    for name, frame in zip((others.get(name, name) for name in names), frames, strict=True):
        if name in frame_of:
            raise InputError(f"{source} has two frames for '{name}': take one of them out")
        frame_of[name] = {**shared, **frame}
    there = {name: values for name, values in frame_of.items() if is_there(scene, name)}
    views = {name: _read_view(values, scene / name, source, lenses) for name, values in there.items()}
    return views, [name for name in frame_of if name not in there]


def _read_view(values: dict[str, Any], photo: Path, source: Path, lenses: dict[tuple, Lens]) -> View:
    """The view of one frame, whose own values go before those that the file has for all."""
    if any([number_of(values, source, key, 0.0) for key in DISTORTION]):  # no camera of Blender's
        camera = read_camera(values, photo, source, lenses)
    else:
        camera = (*_read_pinhole(values, photo, source), None)
    viewmat = opengl_viewmat(
        values.get("transform_matrix"),
        absent=f"{source}: the frame of {photo.name} has no transform_matrix of 4x4 numbers: export it again",
        wrong=f"{source}: the transform_matrix of {photo.name}",
        remedy=": export again, from a camera of scale 1 in Blender",
    )
    return viewmat, *camera


def _read_pinhole(values: dict[str, Any], photo: Path, source: Path) -> tuple[np.ndarray, tuple[int, int]]:
    number = partial(number_of, values, source)
    width, height = size = photo_size(photo)
    if (number("w", width), number("h", height)) != size:
        raise InputError(
            f"{source}: w and h are {values.get('w', width)}x{values.get('h', height)} but {photo.name} is "
            f"{width}x{height}: use the photos that the file was written for, or take w and h out"
        )
    K = pinhole(values, source, size, angles="x")
    if K is None:
        angle = number("camera_angle_x")
        has = "has no camera_angle_x" if angle is None else f"has camera_angle_x = {angle:g}"
        raise InputError(f"{source} {has}: write the horizontal angle of view there, in radians (0 .. pi)")
    return K, size


def _note(scene: Path, train: Collection[str], test: Collection[str], sizes: np.ndarray, points: str) -> str:
    """What the capture has, in one line."""
    split = f"{len(train)} training and {len(test)} test photos" if test else f"{len(train)} photos, none for testing,"
    with opened_image(scene / min(train)) as photo:
        alpha = ", RGBA" if is_transparent(photo) else ""
    return f"{split} {sizes_text(sizes)}{alpha}; no points, so {points}"
