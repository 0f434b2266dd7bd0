"""Cameras in JSON: ``transforms.json`` of nerfstudio and instant-ngp, and NeRF-synthetic's ``transforms_train.json``.

NeRF-synthetic tells training and test photos apart by file; its photos are named without a suffix and often
transparent.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from turbogs_plugin.captures.camera_json import opengl_viewmat, read_camera, read_frames
from turbogs_plugin.captures.capture import Capture, absence_notes
from turbogs_plugin.captures.photo_files import common_folder, file_named, find_named
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.ply import read_colors, read_vertices

FILE, TRAIN_FILE = "transforms.json", "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""NeRF-synthetic's files of test photos: the first that is there, and has a photo, is used."""
TRAIN, VALIDATION, TEST = LISTS = ("train_filenames", "val_filenames", "test_filenames")
"""Lists of file names in a ``transforms.json`` that are the capture's own split."""


@dataclass(frozen=True)
class FrameView:
    """One frame whose photo is there.

    Args:
        path: of the photo, relative to the scene.
        written: the photo's name in the file, with ``/``.
        viewmat: [4, 4] float64, world to camera (x right, y down, z forward).
        K: [3, 3] float64, undistorted where there is a lens.
        size: (width, height), undistorted where there is a lens.
        lens: None for a pinhole camera.
        mask: the file of its mask; None: the frame names none.
    """

    path: str
    written: str
    viewmat: np.ndarray
    K: np.ndarray
    size: tuple[int, int]
    lens: Lens | None
    mask: Path | None


@dataclass(frozen=True)
class FrameViews:
    """The frames of a file.

    Args:
        content: the file's, with what stands for all frames.
        views: in the file's order.
        absent: names of photos that do not exist.
        notes: on photos that are not where the file says.
    """

    content: dict[str, Any] = field(default_factory=dict)
    views: list[FrameView] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_frame_views(scene: Path, source: Path, lenses: dict[tuple, Lens], anywhere: bool = True) -> FrameViews:
    """The frames of a file. Intrinsics and distortion may stand in each frame or for all.

    Args:
        lenses: lenses by their numbers; new ones are added.
        anywhere: photos may lie in other folders than the file says.

    Raises:
        InputError: a file that is not such JSON, lacks something or describes no lens; a photo that two frames name.
    """
    content, frames = read_frames(source)
    if not all(isinstance(frame.get("file_path"), str) for frame in frames):
        raise InputError(f"{source} has a frame without a file_path: export it again")
    texts = {text for frame in frames for key, text in frame.items() if isinstance(text, str) and key != "file_path"}
    names = [frame["file_path"] for frame in frames]
    paths, notes = find_named(scene, names, source, ("", "images"), texts, anywhere)
    found = FrameViews(content, notes=notes)
    for frame, path in zip(frames, paths, strict=True):
        written = PureWindowsPath(frame["file_path"]).as_posix()
        if path is None:
            found.absent.append(written)
            continue
        viewmat = opengl_viewmat(frame.get("transform_matrix"), f"{source}: the transform_matrix of frame '{path}'")
        camera = read_camera({**content, **frame}, scene / path, source, lenses)
        mask = None
        if frame.get("mask_path") is not None:
            mask = _file(scene, frame["mask_path"], f"mask_path of frame '{path}'", source)
        found.views.append(FrameView(path, written, viewmat, *camera, mask))
    return found


def read_transforms(scene: Path) -> Capture:
    """Read ``scene/transforms.json`` (`read_frame_views`), with the split of its lists.

    Points come from ``ply_file_path``; where it is not given or has none, they are drawn by `starting_points` about
    what the training cameras look at.

    Raises:
        InputError: see `read_frame_views`; lists that are no split; a cloud that is absent or damaged.
    """
    source = scene / FILE
    found = read_frame_views(scene, source, {})
    split = _own_split(found, source)
    views, absent, words, test = found.views, found.absent, "", None
    if split is not None:
        train, test = split
        views = [view for view in views if view.written in train | test]
        absent = [name for name in absent if name in train | test]
        tested = sum(view.written in test for view in views)
        unused = len(found.views) + len(found.absent) - len(views) - len(absent)
        left = f", {unused} others not used" if unused else ""
        words = f", its own split, {len(views) - tested} training and {tested} test photos{left}"
        if not tested:
            raise InputError(f"{source}: none of its {len(test)} test photos is in {scene}: bring them back")
    absence = absence_notes(scene, source, absent, len(views) + len(absent))
    points, colors, origin = np.empty((0, 3)), None, "no points"
    if "ply_file_path" in found.content:
        points, colors = _read_points(_file(scene, found.content["ply_file_path"], "ply_file_path", source))
        origin = f"{len(points):,} points of {found.content['ply_file_path']}"
    kind = f"{source} (nerfstudio, instant-ngp): {len(views)} photos{words}, {origin}"
    return _capture(scene, views, test, points, colors, kind, [*found.notes, *absence]).checked(source)


def read_blender(scene: Path) -> Capture:
    """Read a NeRF-synthetic capture (`read_frame_views`), with the split of its files.

    Where there are no test photos, the split is left to the order of the photos. There are no points: random ones are
    drawn (`starting_points`) about what the training cameras look at.

    Raises:
        InputError: see `read_frame_views`; one photo in both files.
    """
    source = scene / TRAIN_FILE
    lenses: dict[tuple, Lens] = {}
    train = read_frame_views(scene, source, lenses, anywhere=False)  # each folder has an r_0
    absence_notes(scene, source, train.absent, len(train.views) + len(train.absent))
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    test = FrameViews() if test_file is None else read_frame_views(scene, test_file, lenses, anywhere=False)
    names = {view.written for view in test.views}
    if both := sorted({view.path for view in train.views} & {view.path for view in test.views}):
        raise InputError(
            f"{scene}: {len(both)} photos are for training and for testing ({both[0]}): take them out of one"
        )
    views, absent = [*train.views, *test.views], [*train.absent, *test.absent]
    split = f"{len(train.views)} training and {len(names)} test photos" if names else f"{len(train.views)} photos"
    kind = f"{source}{f' and {test_file.name}' if names and test_file else ''} (NeRF-synthetic): {split}, no points"
    absence = absence_notes(scene, source, absent, len(views) + len(absent))
    notes = [*train.notes, *test.notes, *absence]
    return _capture(scene, views, names or None, np.empty((0, 3)), None, kind, notes).checked(source)


def _capture(
    scene: Path,
    views: list[FrameView],
    test: Collection[str] | None,
    points: np.ndarray,
    colors: np.ndarray | None,
    kind: str,
    notes: list[str],
) -> Capture:
    """The capture of some frames, in the order of their photos' names.

    Args:
        test: written names of the test photos; None: no own split.
        points: [M, 3]; where M is 0, points are drawn about what the training cameras look at.
        colors: [M, 3] uint8.
        kind: the first note, which goes on with how points were drawn.
    """
    views = sorted(views, key=lambda view: view.path)
    viewmats, Ks = np.array([view.viewmat for view in views]), np.array([view.K for view in views])
    sizes = np.array([view.size for view in views])
    tested = None if test is None else np.array([view.written in test for view in views])
    if not len(points) and views:
        train = slice(None) if tested is None or tested.all() else ~tested
        points, how = starting_points(viewmats[train], Ks[train], sizes[train])
        colors, kind = None, f"{kind}, so {len(points):,} random ones {how}"
    folder = common_folder(scene, [view.path for view in views])
    return Capture(
        names=tuple((scene / view.path).relative_to(folder).as_posix() for view in views),
        photo_folder=folder,
        viewmats=viewmats,
        Ks=Ks,
        sizes=sizes,
        points=points,
        point_colors=colors,
        lenses=tuple(view.lens for view in views),
        notes=(kind, *notes),
        test=tested,
        mask_files=tuple(view.mask for view in views),
    )


def _own_split(found: FrameViews, source: Path) -> tuple[set[str], set[str]] | None:
    """Written names of the training and of the test photos, by the lists of a ``transforms.json``; None without any.

    Test photos are in ``test_filenames``; where that is absent or empty, in ``val_filenames``. Where both are, all
    photos that are not for training are tests. Without ``train_filenames``, what is in no other list trains.

    Raises:
        InputError: a list that is none or names a photo without a frame; lists that are no split.
    """
    everything = {*(view.written for view in found.views), *found.absent}
    lists: dict[str, set[str]] = {}
    for key in (key for key in LISTS if key in found.content):
        listed = found.content[key]
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{source}: {key} is no list of file names: write one, or take it out")
        lists[key] = {PureWindowsPath(name).as_posix() for name in listed}
        if strange := sorted(lists[key] - everything):
            raise InputError(f"{source}: {key} names '{strange[0]}', which is no frame's file_path: take it out")
    if not lists:
        return None
    test, validation = lists.get(TEST, set()), lists.get(VALIDATION, set())
    train = lists.get(TRAIN, everything - test - validation)
    test = test or validation or everything - train
    if both := sorted(train & test):
        raise InputError(f"{source}: {len(both)} photos are for training and for testing ({both[0]}): mend its lists")
    if not train or not test:
        raise InputError(f"{source}: its lists ({', '.join(lists)}) leave no photo to train or to test on: mend them")
    return train, test


def _file(scene: Path, name: Any, what: str, source: Path) -> Path:
    """A file that a transforms file names; `InputError` where it is not there."""
    path = file_named(scene, name, source) if isinstance(name, str) else None
    if path is None:
        raise InputError(f"{source}: its {what}, {str(name)[:200]!r}, is not there: bring it back, or take it out")
    return scene / path


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """[M, 3] float64 and [M, 3] uint8 of a cloud, grey where it has no colours."""
    vertices = read_vertices(path)
    if not {"x", "y", "z"} <= set(vertices):
        raise InputError(f"{path} has no x, y, z: export it again, or take ply_file_path out")
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = read_colors(path, vertices)
    return points, np.full(points.shape, 128, dtype=np.uint8) if colors is None else colors
