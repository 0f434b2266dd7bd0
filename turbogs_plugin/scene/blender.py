"""NeRF-synthetic captures: ``transforms_train.json`` and its like, as Blender's exporters write them.

Cameras are in OpenGL's axes (x right, y up, z backward), photos are named without a suffix and are often transparent.
Training and test photos are told apart by file, and the validation photos are not used where there are test photos.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.capture import Capture, sizes_text
from turbogs_plugin.scene.photos import is_transparent, opened_image, photo_size
from turbogs_plugin.scene.poses import viewmat_of_pose
from turbogs_plugin.scene.starting_points import random_points
from turbogs_plugin.scene.transforms import number_of, photo_name, read_frames

TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""The first of them that is there names the test photos."""
FILES = (TRAIN_FILE, *TEST_FILES)
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
NAMED_AT_MOST = 3


@dataclass(frozen=True)
class BlenderView:
    """A photo with its camera.

    Args:
        viewmat: [4, 4] float64, world to camera (x right, y down, z forward).
        K: [3, 3] float64 intrinsics.
        size: (width, height) of the photo.
    """

    viewmat: np.ndarray
    K: np.ndarray
    size: tuple[int, int]


def read_blender(scene: Path) -> Capture:
    """Read a capture with the split that its files say.

    Where there is neither a test nor a validation file, the split is left to the order of the photos. There are no
    points: random ones are drawn (`random_points`) about what the training cameras look at.

    Raises:
        InputError: a file that is not such JSON or lacks something, missing photos, or one photo in both files.
    """
    if not (scene / TRAIN_FILE).is_file():
        raise InputError(f"{scene} has no {TRAIN_FILE}, which names the photos to train on: bring it back")
    train = _read_views(scene, scene / TRAIN_FILE)
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    test = {} if test_file is None else _read_views(scene, test_file)
    in_both = sorted(train.keys() & test.keys())
    if in_both:
        raise InputError(
            f"{scene}: {len(in_both)} photos stand both in {TRAIN_FILE} and in {test_file.name} ({in_both[0]}): take "
            f"them out of one; without {' and '.join(TEST_FILES)} every 8th photo is for testing"
        )
    names, views = zip(*sorted({**train, **test}.items()), strict=True)
    points = random_points(np.array([view.viewmat for view in train.values()]))
    capture = Capture(
        names=names,
        photo_folder=scene,
        viewmats=np.array([view.viewmat for view in views]),
        Ks=np.array([view.K for view in views]),
        sizes=np.array([view.size for view in views], dtype=np.int64),
        points=points,
        point_colors=None,
        notes=(_note(scene, train, test, len(points)),),
        test=np.array([name in test for name in names]) if test else None,
    )
    capture.check(scene / TRAIN_FILE)
    return capture


def _read_views(scene: Path, source: Path) -> dict[str, BlenderView]:
    """The views of one file, by the photos' paths relative to the scene."""
    content, frames = read_frames(source)
    shared = {key: value for key, value in content.items() if key != "frames"}
    named: dict[str, dict[str, Any]] = {}
    for frame in frames:
        name = photo_name(scene, frame.get("file_path"), source)
        if name in named:
            raise InputError(f"{source} has two frames for '{name}': take one of them out")
        named[name] = {**shared, **frame}
    missing = [name for name in named if not (scene / name).is_file()]
    if missing:
        more = ", ..." if len(missing) > NAMED_AT_MOST else ""
        raise InputError(
            f"{len(missing)} of {len(named)} photos of {source} are missing ({', '.join(missing[:NAMED_AT_MOST])}"
            f"{more}): bring them back, or take their frames out of the file"
        )
    return {name: _read_view(values, scene / name, source) for name, values in named.items()}


def _read_view(values: dict[str, Any], photo: Path, source: Path) -> BlenderView:
    """The view of one frame, whose own values go before those that the file has for all."""
    number = partial(number_of, values, source)
    bent = [key for key in DISTORTION if number(key, 0.0)]
    if bent:
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
    angle = number("camera_angle_x", 0.0)
    if "fl_x" not in values and not 0.0 < angle < math.pi:
        has = f"has camera_angle_x = {angle:g}" if "camera_angle_x" in values else "has no camera_angle_x"
        raise InputError(f"{source} {has}: write the horizontal angle of view there, in radians (0 .. pi)")
    focal_x = number("fl_x", 0.5 * width / math.tan(0.5 * angle) if angle else 0.0)
    focal_y = number("fl_y", focal_x)
    center_x, center_y = number("cx", 0.5 * width), number("cy", 0.5 * height)
    K = np.array([[focal_x, 0.0, center_x], [0.0, focal_y, center_y], [0.0, 0.0, 1.0]])
    return BlenderView(_viewmat(values.get("transform_matrix"), photo.name, source), K, size)


def _viewmat(matrix: Any, name: str, source: Path) -> np.ndarray:
    """[4, 4] float64 world to camera, of a camera-to-world matrix."""
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{source}: the frame of {name} has no transform_matrix of 4x4 numbers: export it again")
    try:
        return viewmat_of_pose(pose[:3, :3] * [1.0, -1.0, -1.0], pose[:3, 3])
    except ValueError as error:
        raise InputError(
            f"{source}: the transform_matrix of {name} {error}: export again, from a camera of scale 1 in Blender"
        ) from None


def _note(scene: Path, train: dict[str, BlenderView], test: dict[str, BlenderView], points: int) -> str:
    """What the capture was taken for, in one line."""
    size = sizes_text(np.array([view.size for view in (*train.values(), *test.values())]))
    split = f"{len(train)} training and {len(test)} test photos" if test else f"{len(train)} photos, none for testing,"
    with opened_image(scene / min(train)) as photo:
        alpha = ", RGBA" if is_transparent(photo) else ""
    return (
        f"NeRF-synthetic: {split} {size}{alpha}; no points, so {points:,} random ones (seed 0) about what the cameras "
        "look at"
    )
