"""``transforms.json`` of nerfstudio and instant-ngp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from turbogs_plugin.captures.camera_json import opengl_viewmat, read_camera, read_frames
from turbogs_plugin.captures.capture import Capture, left_out, require_enough
from turbogs_plugin.captures.photo_files import file_named, find_frame_photos
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.ply import read_colors, read_vertices

FILE = "transforms.json"
TRAIN, VALIDATION, TEST = LISTS = ("train_filenames", "val_filenames", "test_filenames")
"""Lists of file names that are the capture's own split."""


@dataclass(frozen=True)
class FrameView:
    """One frame whose photo is there.

    Args:
        viewmat: [4, 4] float64, world to camera (x right, y down, z forward).
        K: [3, 3] float64, undistorted where there is a lens.
        size: (width, height), undistorted where there is a lens.
        lens: None for a pinhole camera.
        mask: the file of its mask; None: the frame names none.
    """

    viewmat: np.ndarray
    K: np.ndarray
    size: tuple[int, int]
    lens: Lens | None
    mask: Path | None


@dataclass
class FrameViews:
    """The frames of one file.

    Args:
        views: by their photos' paths relative to the scene, in the file's order.
        absent: names of photos that do not exist.
        written: photo's path, or the name of an absent one, by its name in the file.
        notes: on photos that are not where the file says.
        unclear: why absent ones were not found elsewhere, for the line on them.
    """

    views: dict[str, FrameView] = field(default_factory=dict)
    absent: list[str] = field(default_factory=list)
    written: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    unclear: str = ""


def read_frame_views(
    scene: Path, source: Path, lenses: dict[tuple, Lens], remedy: str = "export it again"
) -> tuple[dict[str, Any], FrameViews]:
    """The content of a file of frames but for these, and the frames.

    Intrinsics and distortion may stand in each frame or for all. A frame's ``mask_path`` is its mask. Frames whose
    photo does not exist are left out.

    Args:
        lenses: lenses by their numbers; new ones are added.
        remedy: for a pose that is none.

    Raises:
        InputError: a file that is not such JSON, lacks something or describes no lens; a photo that two frames name.
    """
    content, frames = read_frames(source)
    written = [_file_path(frame, source) for frame in frames]
    others = {text for frame in frames for key, text in frame.items() if isinstance(text, str) and key != "file_path"}
    photos, note, unclear = find_frame_photos(scene, written, others, source)
    found = FrameViews(notes=[note] if note else [], unclear=unclear)
    for text, photo, frame in zip(written, photos, frames, strict=True):
        name = PureWindowsPath(text).as_posix()
        key = photo or name
        if key in found.views or key in found.absent:
            raise InputError(f"{source} has two frames for '{key}': take one of them out")
        found.written[text] = key
        if photo is None:
            found.absent.append(name)
            continue
        viewmat = opengl_viewmat(
            frame.get("transform_matrix"),
            absent=f"{source}: frame '{photo}' has no transform_matrix of 4x4 finite numbers: export it again",
            wrong=f"{source}: the transform_matrix of frame '{photo}'",
            remedy=f": {remedy}",
        )
        camera = read_camera({**content, **frame}, scene / photo, source, lenses)
        found.views[photo] = FrameView(viewmat, *camera, _mask_file(scene, frame, photo, source))
    return content, found


def read_transforms(scene: Path) -> Capture:
    """Read ``scene/transforms.json`` (`read_frame_views`).

    Lists of file names are the capture's own split. Points come from ``ply_file_path``; where it is not given or has
    none, they are drawn by `starting_points` about what the training cameras look at.

    Raises:
        InputError: see `read_frame_views`; lists that are no split; a cloud that is absent or damaged.
    """
    source = scene / FILE
    content, found = read_frame_views(scene, source, {})
    test_names, unused, split = _own_split(content, found, scene, source)
    views = {name: view for name, view in found.views.items() if name not in unused}
    absent = [name for name in found.absent if name not in unused]
    require_enough(scene, source, absent, len(views) + len(absent), found.unclear)
    test = None
    if test_names is not None:
        test = np.array([name in test_names for name in sorted(views)])
        if not test.any():
            raise InputError(f"{source}: none of its {len(test_names)} test photos is in {scene}: bring them back")
    points, colors, origin = np.empty((0, 3)), None, "no points"
    if "ply_file_path" in content:
        points, colors = _read_points(scene, content["ply_file_path"], source)
        origin = f"{len(points):,} points of {content['ply_file_path']}"
    # Reduced copies lie in images_2, images_4, ... beside images.
    common = {PurePosixPath(name).parts[0] for name in views}
    inside = len(common) == 1 and all(len(PurePosixPath(name).parts) > 1 for name in views)
    capture = capture_of_views(scene, scene / common.pop() if inside else scene, views, test, points, colors)
    if capture.point_colors is None:
        origin = f"{origin}, so {len(capture.points):,} random ones {capture.notes[0]}"
    notes = [f"{source} (nerfstudio, instant-ngp): {len(views)} photos{split}, {origin}", *found.notes]
    if absent:
        notes.append(left_out(absent, len(views) + len(absent), "frames"))
    capture.notes = tuple(notes)
    return capture.checked(source)


def capture_of_views(
    scene: Path,
    photo_folder: Path,
    views: Mapping[str, FrameView],
    test: np.ndarray | None,
    points: np.ndarray,
    colors: np.ndarray | None,
) -> Capture:
    """The capture of some frames, in the order of their photos' names.

    Args:
        photo_folder: the scene, or a folder in it that has all photos.
        test: [V] bool in that order; None: no own split.
        points: [M, 3]; where M is 0, points are drawn about what the training cameras look at, and how is its note.
        colors: [M, 3] uint8.
    """
    ordered = [views[name] for name in sorted(views)]
    viewmats, intrinsics = np.array([view.viewmat for view in ordered]), np.array([view.K for view in ordered])
    sizes, how = np.array([view.size for view in ordered]), ""
    if not len(points):
        train = slice(None) if test is None or test.all() else ~test
        points, how = starting_points(viewmats[train], intrinsics[train], sizes[train])
        colors = None
    return Capture(
        names=tuple((scene / name).relative_to(photo_folder).as_posix() for name in sorted(views)),
        photo_folder=photo_folder,
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=points,
        point_colors=colors,
        lenses=tuple(view.lens for view in ordered),
        notes=(how,),
        test=test,
        mask_files=tuple(view.mask for view in ordered),
    )


def _file_path(frame: dict[str, Any], source: Path) -> str:
    if not isinstance(name := frame.get("file_path"), str):
        raise InputError(f"{source} has a frame without a file_path: export it again")
    return name


def _mask_file(scene: Path, frame: dict[str, Any], name: str, source: Path) -> Path | None:
    """The mask that a frame names; `InputError` where it is not there."""
    path = frame.get("mask_path")
    if path is None:
        return None
    if not isinstance(path, str):
        raise InputError(f"{source}: mask_path of frame '{name}' is not a path: write one, or take it out")
    if (file := file_named(scene, path, source)) is None:
        raise InputError(f"{source}: frame '{name}' names the mask {scene / path}, which is not there: bring it back")
    return scene / file


def _own_split(
    content: dict[str, Any], found: FrameViews, scene: Path, source: Path
) -> tuple[frozenset[str] | None, frozenset[str], str]:
    """The split that a transforms.json states.

    Test photos are in ``test_filenames``; where that is absent or empty, in ``val_filenames``. Where both are, all
    photos that are not for training are tests. Without ``train_filenames``, what is in no other list trains.

    Returns:
        Names of the test photos, None where the file has none of the lists; names of photos in neither part; words for
        the note on the capture.

    Raises:
        InputError: a list that is none or names a photo without a frame; a photo for training and testing; no photos to
            train or to test on.
    """
    lists = {key: _listed(content[key], key, found, scene, source) for key in LISTS if key in content}
    if not lists:
        return None, frozenset(), ""
    named, train = frozenset(found.written.values()), lists.get(TRAIN)
    test_key = next((key for key in (TEST, VALIDATION) if lists.get(key)), "")
    if not test_key and not train:
        raise InputError(f"{source}: {' and '.join(lists)} are empty: name photos there, or take the lists out")
    if train is None:
        train = named - lists.get(TEST, frozenset()) - lists.get(VALIDATION, frozenset())
    test = lists[test_key] if test_key else named - train
    if both := sorted(train & test):
        raise InputError(
            f"{source}: {len(both)} photos are in {TRAIN} and in {test_key} ({both[0]}): take them out of one of them"
        )
    for part, what in ((train, "train"), (test, "test")):
        if not part:
            raise InputError(f"{source}: its lists ({', '.join(lists)}) leave no photo to {what} on: mend them")
    unused = named - train - test
    there = [name for name in found.views if name not in unused]
    tested = sum(name in test for name in there)
    left = f", {len(unused)} others not used" if unused else ""
    origin = test_key or f"in no {TRAIN}"
    return test, unused, f", its own split, {len(there) - tested} training and {tested} test photos ({origin}){left}"


def _listed(listed: Any, key: str, found: FrameViews, scene: Path, source: Path) -> frozenset[str]:
    """The photos that one list names."""
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{source}: {key} is no list of file names: write one, or take it out")
    photos = {name: found.written.get(name) or file_named(scene, name, source, photo=True) for name in listed}
    named = set(found.written.values())
    if strange := [name for name, photo in photos.items() if photo not in named]:
        more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
        raise InputError(
            f"{source}: {key} names '{strange[0]}'{more}, which no frame has: write it as in its frame's file_path, or "
            "take it out"
        )
    return frozenset(photo for photo in photos.values() if photo)


def _read_points(scene: Path, name: Any, source: Path) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(name, str):
        raise InputError(f"{source}: ply_file_path is not a path: write one, or take it out")
    if (file := file_named(scene, name, source)) is None:
        raise InputError(
            f"{source}: its ply_file_path {scene / name} is not there: bring it back, or take that line out, to begin "
            "with random points"
        )
    path = scene / file
    vertices = read_vertices(path)
    if not {"x", "y", "z"} <= set(vertices):
        raise InputError(f"{path} has no x, y, z: export it again, or take ply_file_path out of {source.name}")
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = read_colors(path, vertices)
    return points, np.full(points.shape, 128, dtype=np.uint8) if colors is None else colors
