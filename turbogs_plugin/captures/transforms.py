"""Cameras in JSON: ``transforms.json`` of nerfstudio and instant-ngp, and NeRF-synthetic's ``transforms_train.json``.

NeRF-synthetic tells training and test photos apart by file; its photos are named without a suffix and often
transparent.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from turbogs_plugin.captures.camera_json import FOR_ALL, opengl_viewmat, read_camera, read_frames
from turbogs_plugin.captures.capture import FEWEST_PHOTOS, Capture
from turbogs_plugin.captures.photo_files import file_named, find_named
from turbogs_plugin.captures.starting_points import GREY, clouds_beside, read_cloud
from turbogs_plugin.errors import InputError

FILE, TRAIN_FILE = "transforms.json", "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""NeRF-synthetic's files of test photos: the first that is there, and has a photo, is used."""
TRAIN, VALIDATION, TEST = LISTS = ("train_filenames", "val_filenames", "test_filenames")
"""Lists of file names in a ``transforms.json`` that are the capture's own split."""

TEST_FRAMES = "test_frames"
"""Frames to test on, which are not among the others (ScanNet++)."""

Frame = dict[str, Any]
"""A frame of a file, with what stands there for all frames."""


def read_transforms(scene: Path) -> Capture:
    """Read ``scene/transforms.json``, with the split of its lists, and points of its ``ply_file_path``.

    Raises:
        InputError: a file that is not such JSON, lacks something or describes no lens; a photo that two frames name;
            lists that are no split; a cloud that is absent or damaged.
    """
    source = scene / FILE
    content, frames = _frames(source)
    split = _own_split(content, frames, source)
    words, test = "", None
    if split is not None:
        train, test = split
        used = [frame for frame in frames if _written(frame) in train | test]
        words = f", {len(frames) - len(used)} others not used" if len(used) < len(frames) else ""
        frames = used
    if content.get(TEST_FRAMES):
        tested = _frames(source, TEST_FRAMES)[1]
        frames, test = [*frames, *tested], {*(test or ()), *map(_written, tested)}
        words += f", with {TEST_FRAMES}"
    return _capture(scene, source, content, frames, test, f"nerfstudio, instant-ngp{words}")


def read_blender(scene: Path) -> Capture:
    """Read a NeRF-synthetic capture, with the split of its files; where there are no test photos, the split is left to
    the order of the photos.

    Raises:
        InputError: as `read_transforms`; one photo in both files.
    """
    source = scene / TRAIN_FILE
    content, train = _frames(source)
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    tested = [] if test_file is None else _frames(test_file)[1]
    words = f"NeRF-synthetic{f', with {test_file.name}' if test_file else ''}"
    return _capture(scene, source, content, [*train, *tested], {_written(frame) for frame in tested}, words)


def _frames(source: Path, key: str = "frames") -> tuple[dict[str, Any], list[Frame]]:
    """A file's content, and its frames. Intrinsics and distortion may stand in each frame or for all."""
    content, frames = read_frames(source, key)
    if not all(isinstance(frame.get("file_path"), str) for frame in frames):
        raise InputError(f"{source} has a frame without a file_path: export it again")
    shared = {key: content[key] for key in FOR_ALL if key in content}
    return content, [{**shared, **frame} for frame in frames]


def _written(frame: Frame) -> str:
    """The photo's name in the file, with ``/``."""
    return PureWindowsPath(frame["file_path"]).as_posix()


def _capture(
    scene: Path,
    source: Path,
    content: dict[str, Any],
    frames: list[Frame],
    test: Collection[str] | None,
    words: str,
) -> Capture:
    """The capture of some frames, in the order of their photos' names; damaged poses are left out (`Capture.checked`).

    Args:
        content: of the file; its ``ply_file_path`` has the points.
        test: written names of the test photos; None, and where none of them exists: no own split.
        words: on the kind of capture.
    """
    names, cloud = [_written(frame) for frame in frames], content.get("ply_file_path")
    others = {text for frame in frames for key, text in frame.items() if key != "file_path" and isinstance(text, str)}
    found = find_named(scene, [frame["file_path"] for frame in frames], source, ("", "images"), others)
    rows, damaged = [], []
    for name, place in zip(found.names, found.places, strict=True):
        frame, owner = frames[place], f"frame '{names[place]}'"
        try:
            pose = opengl_viewmat(frame.get("transform_matrix"), f"{source}: the transform_matrix of {owner}")
        except InputError as error:
            pose = np.full((4, 4), np.nan)
            damaged.append(error)
        mask = None if "mask_path" not in frame else _file(scene, frame["mask_path"], f"mask_path of {owner}", source)
        rows.append((pose, *read_camera(frame, found.folder / name, source), mask))
    viewmats, Ks, sizes, lenses, masks = zip(*rows, strict=True)
    points, colors, file = np.empty((0, 3)), None, None
    if cloud is not None:
        points, colors = read_cloud(file := _file(scene, cloud, "ply_file_path", source))
        words += f", {len(points):,} points of {cloud}{', grey as it has no colours' if colors is None else ''}"
        colors = np.full(points.shape, GREY, np.uint8) if colors is None else colors
    tested = np.array([names[place] in (test or ()) for place in found.places])
    if damaged and (np.isfinite(viewmats).all(axis=(1, 2)) & ~tested).sum() < FEWEST_PHOTOS:
        raise damaged[0]
    split = f", by its own split {(~tested).sum()} for training, {tested.sum()} for testing" if tested.any() else ""
    return Capture(
        names=found.names,
        photo_folder=found.folder,
        viewmats=np.array(viewmats),
        Ks=np.array(Ks),
        sizes=np.array(sizes),
        points=points,
        point_colors=colors,
        lenses=lenses,
        notes=(
            f"{source} ({words}): {len(found.names)} photos{split}",
            *found.notes,
            *clouds_beside([scene], file, f"name one as ply_file_path in {source.name} to begin with its points"),
        ),
        test=tested if tested.any() else None,
        mask_files=masks,
    ).checked(source)


def _own_split(content: dict[str, Any], frames: list[Frame], source: Path) -> tuple[set[str], set[str]] | None:
    """Written names of the training and of the test photos, by the lists of a ``transforms.json``; None without any.

    Test photos are in ``test_filenames``; where that is absent or empty, in ``val_filenames``. Where both are, all
    photos that are not for training are tests. Without ``train_filenames``, what is in no other list trains.

    Raises:
        InputError: lists that are no split.
    """
    lists = {key: content[key] for key in LISTS if content.get(key)}
    if not lists:
        return None
    everything = {_written(frame) for frame in frames}
    if all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists.values()):
        listed = {key: {PureWindowsPath(name).as_posix() for name in names} for key, names in lists.items()}
        test, validation = listed.get(TEST, set()), listed.get(VALIDATION, set())
        train = listed.get(TRAIN, everything - test - validation)
        test = test or validation or everything - train
        if train and test and not train & test and train | test | validation <= everything:
            return train, test
    raise InputError(
        f"{source}: {', '.join(lists)} are no split: give lists of frames' file_path, with photos to train and to test "
        "on and none for both"
    )


def _file(scene: Path, name: Any, what: str, source: Path) -> Path:
    """A file that a transforms file names; `InputError` where it is not there."""
    path = file_named(scene, name, source) if isinstance(name, str) else None
    if path is None:
        raise InputError(f"{source}: its {what}, {str(name)[:200]!r}, is not there: bring it back, or take it out")
    return scene / path
