"""NeRF-synthetic captures: ``transforms_train.json`` and its like, as Blender's exporters write them.

Cameras are in OpenGL's axes (x right, y up, z backward), photos are named without a suffix and are often transparent.
Training and test photos are told apart by file, and the validation photos are not used where there are test photos.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.capture import Capture, named, sizes_text
from turbogs_plugin.scene.photos import is_transparent, opened_image, photo_size
from turbogs_plugin.scene.starting_points import starting_points
from turbogs_plugin.scene.transforms import number_of, opengl_viewmat, photo_name, pinhole, read_frames

TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""The first of them that is there names the test photos."""
FILES = (TRAIN_FILE, *TEST_FILES)
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


View = tuple[np.ndarray, np.ndarray, tuple[int, int]]
"""A photo's camera: [4, 4] float64 world to camera (x right, y down, z forward), [3, 3] float64 intrinsics, (width,
height) of the photo."""


def read_blender(scene: Path) -> Capture:
    """Read a capture with the split that its files say.

    Where there is neither a test nor a validation file, the split is left to the order of the photos. There are no
    points: random ones are drawn (`starting_points`) about what the training cameras look at.

    Raises:
        InputError: a file that is not such JSON or lacks something, missing photos, or one photo in both files.
    """
    if not (scene / TRAIN_FILE).is_file():
        raise InputError(f"{scene} has no {TRAIN_FILE}, which names the photos to train on: bring it back")
    train = _read_views(scene, scene / TRAIN_FILE)
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    test = {} if test_file is None else _read_views(scene, test_file)
    if in_both := sorted(train.keys() & test.keys()):
        raise InputError(
            f"{scene}: {len(in_both)} photos stand both in {TRAIN_FILE} and in {test_file.name} ({in_both[0]}): take "
            f"them out of one; without {' and '.join(TEST_FILES)} every 8th photo is for testing"
        )
    names, views = zip(*sorted({**train, **test}.items()), strict=True)
    viewmats, Ks, sizes = (np.array(part) for part in zip(*views, strict=True))
    points, where = starting_points(*(np.array(part) for part in zip(*train.values(), strict=True)))
    return Capture(
        names=names,
        photo_folder=scene,
        viewmats=viewmats,
        Ks=Ks,
        sizes=sizes,
        points=points,
        point_colors=None,
        notes=(_note(scene, train, test, sizes, f"{len(points):,} random ones (seed 0){where}"),),
        test=np.array([name in test for name in names]) if test else None,
    ).checked(scene / TRAIN_FILE)


def _read_views(scene: Path, source: Path) -> dict[str, View]:
    """The views of one file, by the photos' paths relative to the scene."""
    content, frames = read_frames(source)
    shared = {key: value for key, value in content.items() if key != "frames"}
    frame_of: dict[str, dict[str, Any]] = {}
    for frame in frames:
        name = photo_name(scene, frame.get("file_path"), source)
        if name in frame_of:
            raise InputError(f"{source} has two frames for '{name}': take one of them out")
        frame_of[name] = {**shared, **frame}
    if missing := [name for name in frame_of if not (scene / name).is_file()]:
        raise InputError(
            f"{len(missing)} of {len(frame_of)} photos of {source} are missing ({named(missing)}): bring them back, or "
            "take their frames out of the file"
        )
    return {name: _read_view(values, scene / name, source) for name, values in frame_of.items()}


def _read_view(values: dict[str, Any], photo: Path, source: Path) -> View:
    """The view of one frame, whose own values go before those that the file has for all."""
    number = partial(number_of, values, source)
    if bent := [key for key in DISTORTION if number(key, 0.0)]:
        raise InputError(
            f"{source}: {', '.join(bent)} of {photo.name} say that its lens distorts, which Blender's cameras do not: "
            "name the file transforms.json"
        )
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
    viewmat = opengl_viewmat(
        values.get("transform_matrix"),
        absent=f"{source}: the frame of {photo.name} has no transform_matrix of 4x4 numbers: export it again",
        wrong=f"{source}: the transform_matrix of {photo.name}",
        remedy=": export again, from a camera of scale 1 in Blender",
    )
    return viewmat, K, size


def _note(scene: Path, train: Collection[str], test: Collection[str], sizes: np.ndarray, points: str) -> str:
    """What the capture was taken for, in one line."""
    split = f"{len(train)} training and {len(test)} test photos" if test else f"{len(train)} photos, none for testing,"
    with opened_image(scene / min(train)) as photo:
        alpha = ", RGBA" if is_transparent(photo) else ""
    return f"NeRF-synthetic: {split} {sizes_text(sizes)}{alpha}; no points, so {points}"
