"""Cameras in JSON: ``transforms.json`` of nerfstudio and instant-ngp, and NeRF-synthetic's ``transforms_train.json``.

Cameras have OpenGL's axes (x right, y up, z backward); by ``"axes": "opencv"``, a key of this project, OpenCV's.
NeRF-synthetic tells training and test photos apart by file; its photos are named without a suffix, often transparent.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, Capture, text_of
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.photo_files import file_named, find_named
from turbogs_plugin.captures.starting_points import clouds_beside, read_cloud
from turbogs_plugin.captures.undistort import LARGEST_SIDE, Lens, load_pycolmap, pinhole_of_camera
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.agreement import OTHER_AXES
from turbogs_plugin.scene.geometry import viewmat_of_pose
from turbogs_plugin.yaml_json import parse_json, require_json_size

FILE, TRAIN_FILE = "transforms.json", "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""NeRF-synthetic's files of test photos: the first that is there, and has a photo, is used."""
TRAIN, VALIDATION, TEST = LISTS = ("train_filenames", "val_filenames", "test_filenames")
"""Lists of file names in a ``transforms.json`` that are the capture's own split."""
TEST_FRAMES = "test_frames"  # frames to test on, which are not among the others (ScanNet++)
BROWN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
"""Names of one model, whose missing coefficients are 0."""
FISHEYE = "OPENCV_FISHEYE"
BENDS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # of distortion, as COLMAP's FULL_OPENCV has them
Frame = ChainMap[str, Any]  # a frame of a file; what stands there for all frames counts where the frame lacks it


def read_transforms(scene: Path) -> Capture:
    """Read ``scene/transforms.json``, with the split of its lists, and points of its ``ply_file_path``. Raises
    `InputError` for a file that is not such JSON, lacks something or describes no lens; a photo that two frames name;
    lists that are no split; a cloud that is absent or damaged."""
    content, frames = frames_of(source := scene / FILE)
    train, test = _own_split(content, {_written(frame) for frame in frames}, source)
    used = [frame for frame in frames if _written(frame) in train | test]
    words = f", {len(frames) - len(used)} others not used" if len(used) < len(frames) else ""
    if content.get(TEST_FRAMES):
        tested = frames_of(source, TEST_FRAMES)[1]
        used, test, words = [*used, *tested], {*test, *map(_written, tested)}, f"{words}, with {TEST_FRAMES}"
    return _capture(source, content, used, test, f"nerfstudio, instant-ngp{words}")


def read_blender(scene: Path) -> Capture:
    """Read a NeRF-synthetic capture, with the split of its files; where there are no test photos, the split is left to
    the order of the photos. Raises `InputError` as `read_transforms`, and for one photo in both files."""
    content, train = frames_of(source := scene / TRAIN_FILE)
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    tested, words = ([], "") if test_file is None else (frames_of(test_file)[1], f", with {test_file.name}")
    test = {_written(frame) for frame in tested}
    return _capture(source, content, [*train, *tested], test, f"NeRF-synthetic{words}")


def read_frames(source: Path, key: str = "frames") -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A transforms file and its frames under a key, without null and empty texts, which other writers have for what is
    absent. Raises `InputError` unless it is JSON with a list of frames."""
    require_json_size(source)
    content = parse_json(text_of(source), str(source))
    frames = content.get(key) if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source} has no list of {key}: export it again")
    content, *frames = ({k: v for k, v in each.items() if v is not None and v != ""} for each in (content, *frames))
    return content, frames


def frames_of(source: Path, key: str = "frames") -> tuple[dict[str, Any], list[Frame]]:
    """A file's content, and its frames. Intrinsics and distortion may stand in each frame or for all."""
    content, frames = read_frames(source, key)
    if not all(isinstance(frame.get("file_path"), str) for frame in frames):
        raise InputError(f"{source} has a frame without a file_path: export it again")
    distinct = {repr(frame): frame for frame in frames}.values()  # of equal ones the first
    return content, [ChainMap(frame, content) for frame in distinct]


def _written(frame: Frame) -> str:
    """The photo's name in the file, with ``/``."""
    return PureWindowsPath(frame["file_path"]).as_posix()


def _capture(source: Path, content: dict[str, Any], frames: list[Frame], test: set[str], words: str) -> Capture:
    """The capture of some frames, in the order of their photos' names; damaged poses are left out (`Capture.checked`).
    `content` is the file's, whose ``ply_file_path`` has the points; `test` has written names of the test photos: where
    none of them exists, there is no own split; `words` are on the kind of capture."""
    names, cloud, scene = [_written(frame) for frame in frames], content.get("ply_file_path"), source.parent
    said = (content, *(frame.maps[0] for frame in frames))
    others = {text for values in said for key, text in values.items() if key != "file_path" and isinstance(text, str)}
    found = find_named(scene, [frame["file_path"] for frame in frames], source, ("", "images"), others)
    rows, damaged = [], []
    for name, place in zip(found.names, found.places, strict=True):
        frame, owner = frames[place], f"frame '{names[place]}'"
        try:
            pose = opengl_viewmat(frame.get("transform_matrix"), f"{source}: the transform_matrix of {owner}")
        except InputError as error:
            pose = np.full((4, 4), np.nan)
            damaged.append(error)
        mask = None if "mask_path" not in frame else _file(frame["mask_path"], f"mask_path of {owner}", source)
        rows.append((pose, *_read_camera(frame, found.folder / name, source), mask))
    viewmats, Ks, sizes, lenses, masks = zip(*rows, strict=True)
    axes = {"opengl": np.eye(4), "opencv": OTHER_AXES}.get(str(content.get("axes", "opengl")).lower())
    if axes is None:
        raise InputError(f'{source}: its axes are {str(content["axes"])[:40]!r}: write "opengl" or "opencv"')
    points, colors, file = np.empty((0, 3)), np.empty((0, 3), np.uint8), None
    if cloud is not None:
        points, colors, grey = read_cloud(file := _file(cloud, "ply_file_path", source))
        words += f", {len(points):,} points of {cloud}{grey}"
    tested = np.array([names[place] in test for place in found.places])
    if damaged and (np.isfinite(viewmats).all(axis=(1, 2)) & ~tested).sum() < FEWEST_PHOTOS:
        raise damaged[0]
    split = f", by its own split {(~tested).sum()} for training, {tested.sum()} for testing" if tested.any() else ""
    return Capture(
        names=found.names,
        photo_folder=found.folder,
        viewmats=axes @ viewmats,
        Ks=np.array(Ks),
        sizes=np.array(sizes),
        points=points,
        point_colors=colors,
        lenses=lenses,
        notes=(
            f"{source} ({words}): {len(found.names)} photos{split}",
            *(["its depth maps are for loss.depth_weight alone"] * any("depth_file_path" in frame for frame in frames)),
            *found.notes,
            *clouds_beside([scene], file, f"name one as ply_file_path in {source.name} to begin with its points"),
        ),
        test=tested if tested.any() else None,
        mask_files=masks,
    ).checked(source)


def _own_split(content: dict[str, Any], everything: set[str], source: Path) -> tuple[set[str], set[str]]:
    """Written names of the training and of the test photos, by the lists of a ``transforms.json``; no test photos
    without any list.

    Test photos are in ``test_filenames``; where that is absent or empty, in ``val_filenames``. Where both are, all
    photos that are not for training are tests. Without ``train_filenames``, what is in no other list trains."""
    lists = {key: content[key] for key in LISTS if content.get(key)}
    if not lists:
        return everything, set()
    if all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists.values()):
        listed = {key: {PureWindowsPath(name).as_posix() for name in names} for key, names in lists.items()}
        test, validation = listed.get(TEST, set()), listed.get(VALIDATION, set())
        train = listed.get(TRAIN, everything - test - validation)
        test = test or validation or everything - train
        if train and test and not train & test and train | test | validation <= everything:
            return train, test
    remedy = "give lists of frames' file_path, with photos to train and to test on and none for both"
    raise InputError(f"{source}: {', '.join(lists)} are no split: {remedy}")


def _file(name: Any, what: str, source: Path) -> Path:
    """A file that a transforms file names; `InputError` where it is not there."""
    if isinstance(name, str) and (path := file_named(source.parent, name, source)):
        return source.parent / path
    raise InputError(f"{source}: its {what}, {str(name)[:200]!r}, is not there: bring it back, or take it out")


def number_of(values: Mapping[str, Any], source: Path, key: str, default: float | None = None) -> float | None:
    """A finite number, also one that is written as text, or the default where the key is absent."""
    if key not in values:
        return default
    value = values[key]
    try:
        if isinstance(value, bool) or not abs(number := float(value)) < 1e300:
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        raise InputError(f"{source}: {key} is {str(value)[:40]!r}: it must be a finite number") from None
    return number


def _read_camera(values: Frame, photo: Path, source: Path) -> tuple[np.ndarray, tuple[int, int], Lens | None]:
    """[3, 3] float64 intrinsics, (width, height), and the lens where there is distortion, of one frame."""
    number, owner = partial(number_of, values, source), f"{source}: the camera of {photo.name}"
    width, height = number("w"), number("h")
    if width is None or height is None:
        width, height = photo_size(photo)
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"{owner} is {width:g}x{height:g} pixels: write the photo's size as w and h, or take them out")
    K, size = pinhole(values, source, (width, height)), (round(width), round(height))
    if K is None:
        remedy = "write one of them there (pixels, radians), or find the cameras anew by 'turbogs reconstruct'"
        raise InputError(f"{owner} has neither fl_x nor a camera_angle_x in 0 .. pi: {remedy}")
    fisheye = str(values.get("is_fisheye")).lower() in ("true", "1")
    model = str(values.get("camera_model", FISHEYE if fisheye else "OPENCV")).upper()
    if model not in (*BROWN_MODELS, FISHEYE):
        models = ", ".join((*BROWN_MODELS, FISHEYE))
        raise InputError(f"{owner} is a {model[:40]!r}: known are {models}; use COLMAP's model, flat cuts of panoramas")
    bends = {key: number(key, 0.0) or 0.0 for key in BENDS}
    known = ("k1", "k2", "k3", "k4") if model == FISHEYE else ("k1", "k2", "k3", "p1", "p2")
    if unknown := " and ".join(key for key, value in bends.items() if value and key not in known):
        raise InputError(f"{owner} has {unknown}, which {model} does not have: use the capture's COLMAP reconstruction")
    if model != FISHEYE and not any(bends.values()):
        return K, size, None
    kind = model if model == FISHEYE else "FULL_OPENCV" if bends["k3"] else "OPENCV"
    keys = {FISHEYE: known, "FULL_OPENCV": BENDS, "OPENCV": BENDS[:4]}[kind]
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *(bends[key] for key in keys)]
    return pinhole_of_camera(load_pycolmap().Camera(model=kind, width=size[0], height=size[1], params=params), owner)


def pinhole(values: Mapping[str, Any], source: Path, size: tuple[float, float]) -> np.ndarray | None:
    """[3, 3] float64 intrinsics of one frame; None where nothing gives its horizontal focal length. The principal point
    is in the middle of the `size` (width, height) unless it is given."""
    focals: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        focal = number_of(values, source, f"fl_{axis}")
        angle = number_of(values, source, f"camera_angle_{axis}") if focal is None else None
        if angle is not None and 0 < angle < math.pi:
            focal = 0.5 * side / math.tan(0.5 * angle)
        focals.append(focals[0] if focal is None and focals else focal)
    if focals[0] is None:
        return None
    x, y = (number_of(values, source, f"c{axis}", 0.5 * side) for axis, side in zip("xy", size, strict=True))
    return np.array([[focals[0], 0.0, x], [0.0, focals[1], y], [0.0, 0.0, 1.0]])


def opengl_viewmat(matrix: Any, owner: str) -> np.ndarray:
    """[4, 4] float64 world to camera, of a camera-to-world matrix in OpenGL's axes; its numbers may be in one row, and
    the matrix be transposed, where its last column says so. Raises `InputError` where it is no matrix of 4x4 finite
    numbers, or no rotation and translation; `owner` names it."""
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        pose = np.empty(0)
    if pose.shape in ((12,), (16,)):
        pose = pose.reshape(-1, 4)
    if pose.shape == (4, 4) and (pose[:, 3] == (0, 0, 0, 1)).all():
        pose = pose.T  # or the camera is in the origin, and has a last row like that, too
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{owner} is no matrix of 4x4 numbers: export it again")
    try:
        return viewmat_of_pose(pose[:3, :3] * [1.0, -1.0, -1.0], pose[:3, 3])
    except ValueError as error:
        raise InputError(f"{owner} {error}: export it again, without a scale of the camera") from None
