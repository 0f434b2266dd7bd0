"""``transforms.json`` of nerfstudio and instant-ngp: cameras in OpenGL's axes (x right, y up, z backward)."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import LARGEST_SIDE, Capture, check_photo_name, left_out
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.frame_photos import elsewhere_note, find_elsewhere, require_enough
from turbogs_plugin.captures.named_split import read_split
from turbogs_plugin.captures.starting_points import starting_points
from turbogs_plugin.captures.undistort import Lens, brown_projection, lens_of_camera, make_lens
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import viewmat_of_pose
from turbogs_plugin.scene.ply import read_colors, read_vertices

FILE = "transforms.json"
BROWN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
"""Names of one model, whose missing coefficients are 0."""
FISHEYE_MODELS = ("OPENCV_FISHEYE",)
MATRICES = ("K", "intrinsic_matrix")
"""Keys of intrinsics as a matrix, of which NeuS2 writes the second."""
LARGEST_SKEW = 0.5
"""Of their entry [0, 1], in pixels: decompositions of projections leave a small one, which counts as none."""
PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg")


def read_frames(source: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A transforms file, and its frames. Raises `InputError` unless it is JSON with a list of frames."""
    try:
        content = json.loads(source.read_text(encoding="utf-8-sig"))  # Windows' editors write a mark at its beginning
    except (OSError, ValueError, RecursionError) as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error)).split())[:200]
        raise InputError(f"{source} is not readable JSON: {reason}; export or copy it again") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source} has no list of frames: export it again")
    return content, frames


def read_transforms(scene: Path) -> Capture:
    """Read ``scene/transforms.json``.

    Intrinsics and distortion may stand in each frame or for all; ``camera_angle_x`` serves where there is no ``fl_x``.
    Frames whose photo does not exist are left out. A frame's ``mask_path`` is its mask. Lists of file names are the
    capture's own split (`read_split`). Points come from ``ply_file_path``; where it is not given or has none, they are
    drawn by `starting_points` about what the training cameras look at.

    Photos that are not where the file says are looked for by `other_suffixes` and `find_elsewhere`.

    Raises:
        InputError: a file that is not such JSON, lacks something, or describes no lens; fewer than `FEWEST_PHOTOS`
            photos.
    """
    source = scene / FILE
    content, frames = read_frames(source)
    views: dict[str, tuple[np.ndarray, np.ndarray, tuple[int, int], Lens | None]] = {}
    masks: dict[str, Path | None] = {}
    absent: list[str] = []
    lenses: dict[tuple, Lens] = {}
    names_of_frames = [photo_name(scene, frame.get("file_path"), source) for frame in frames]
    others, unclear = other_suffixes(scene, names_of_frames, source), ""
    others_note = other_suffixes_note(others, source) if others else ""
    if not others and not any(is_there(scene, name) for name in names_of_frames):
        others, unclear = find_elsewhere(scene, names_of_frames, frames)
        others_note = elsewhere_note(scene, others)
    names_of_frames = [others.get(name, name) for name in names_of_frames]

    def name_of(text: str) -> str:
        return others.get(name := photo_name(scene, text, source), name)

    split = read_split(content, set(names_of_frames), name_of, source)
    for name, frame in zip(names_of_frames, frames, strict=True):
        if name in views or name in absent:
            raise InputError(f"{source} has two frames for '{name}': take one of them out")
        if split is not None and name in split.unused:
            continue
        if not is_there(scene, name):
            absent.append(name)
            continue
        masks[name] = _mask_file(scene, frame, name, source)
        viewmat = opengl_viewmat(
            frame.get("transform_matrix"),
            absent=f"{source}: frame '{name}' has no transform_matrix of 4x4 finite numbers: export it again",
            wrong=f"{source}: the transform_matrix of frame '{name}'",
            remedy=": export it again",
        )
        views[name] = (viewmat, *read_camera({**content, **frame}, scene / name, source, lenses))
    require_enough(scene, source, absent, len(views) + len(absent), unclear)
    names, cameras = zip(*sorted(views.items()), strict=True)
    viewmats, intrinsics, sizes, lens_of_view = zip(*cameras, strict=True)
    viewmats, intrinsics, sizes = np.array(viewmats), np.array(intrinsics), np.array(sizes)
    if "ply_file_path" in content:
        points, colors = _read_points(scene, content["ply_file_path"], source)
        origin = f"{len(points):,} points of {content['ply_file_path']}"
    else:
        points, colors = np.empty((0, 3)), None
        origin = "no points"
    test = None if split is None else split.test_views(names)
    if test is not None and not test.any():
        raise InputError(f"{source}: none of its {len(split.test)} test photos is in {scene}: bring them back")
    if not len(points):
        train = slice(None) if test is None or test.all() else ~test
        points, how = starting_points(viewmats[train], intrinsics[train], sizes[train])
        colors, origin = None, f"{origin}, so {len(points):,} random ones {how}"
    parts = "" if split is None else f", {split.text(names)}"
    notes = [f"{source} (nerfstudio, instant-ngp): {len(names)} photos{parts}, {origin}"]
    if others:
        notes.append(others_note)
    if absent:
        notes.append(left_out(absent, len(frames), "frames"))
    # Reduced copies lie in images_2, images_4, ... beside images.
    common = {PurePosixPath(name).parts[0] for name in names}
    photo_folder = scene
    if len(common) == 1 and all(len(PurePosixPath(name).parts) > 1 for name in names):
        photo_folder = scene / common.pop()
    return Capture(
        names=tuple(str((scene / name).relative_to(photo_folder)) for name in names),
        photo_folder=photo_folder,
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=points,
        point_colors=colors,
        lenses=lens_of_view,
        notes=tuple(notes),
        test=test,
        mask_files=tuple(masks[name] for name in names),
    ).checked(source)


def photo_name(scene: Path, name: Any, source: Path) -> str:
    """The photo's path relative to the scene (`_file_name`), with its suffix, which Blender's names come without, if it
    is there. One that leaves the scene stays as it is: no photo `is_there`."""
    if not isinstance(name, str):
        raise InputError(f"{source} has a frame without a file_path: export it again")
    return _file_name(scene, name, source, _photo_there, may_leave=True)


def is_there(scene: Path, name: str) -> bool:
    """Whether a name that `photo_name` gave is that of a file in the scene."""
    path = PureWindowsPath(name)  # knows both kinds of separators, drives and roots
    return not path.anchor and ".." not in path.parts and (scene / name).is_file()


def other_suffixes(scene: Path, names: Sequence[str], source: Path) -> dict[str, str]:
    """Of names without a photo, those for which there is one photo of the same stem with another suffix, and that
    photo's name. None where photos that are there have such neighbours too: these are masks or depths."""
    absent = [name for name in names if not is_there(scene, name)]
    if not absent or any(_neighbours(scene, name) for name in names if is_there(scene, name)):
        return {}
    neighbours = {name: _file_name(scene, name, source, _one_neighbour, may_leave=True) for name in absent}
    taken = Counter([*names, *neighbours.values()])
    return {name: other for name, other in neighbours.items() if other != name and taken[other] == 1}


def other_suffixes_note(others: dict[str, str], source: Path) -> str:
    """What `other_suffixes` found, in one line."""
    name, other = next(iter(others.items()))
    return f"{len(others)} photos have another suffix than in {source.name}: {other} is taken for {name}, ..."


def _neighbours(scene: Path, name: str) -> list[str]:
    suffix = PurePosixPath(name).suffix
    if not suffix or suffix[1:].isdigit():  # a number is part of the name
        return []
    stem = name.removesuffix(suffix)
    letters = ((f"{stem}{each}", f"{stem}{each.upper()}") for each in PHOTO_SUFFIXES if each != suffix.lower())
    there = (next((each for each in both if (scene / each).is_file()), None) for both in letters)
    return [each for each in there if each]


def _one_neighbour(scene: Path, name: str) -> str | None:
    neighbours = _neighbours(scene, name)
    return neighbours[0] if len(neighbours) == 1 else None


def _photo_there(scene: Path, name: str) -> str | None:
    """The name of the photo that is there: with a suffix, or the suffix in other letters, where it lacks that."""
    suffix = PurePosixPath(name).suffix
    stem = name.removesuffix(suffix)
    endings = (*PHOTO_SUFFIXES, *(suffix.upper() for suffix in PHOTO_SUFFIXES))
    names = (name, *(f"{name}{ending}" for ending in endings), f"{stem}{suffix.lower()}", f"{stem}{suffix.upper()}")
    return next((each for each in names if (scene / each).is_file()), None)


def _file_there(scene: Path, name: str) -> str | None:
    return name if (scene / name).is_file() else None


def _file_name(
    scene: Path,
    name: str,
    source: Path,
    there: Callable[[Path, str], str | None] = _file_there,
    may_leave: bool = False,
) -> str:
    """A file's path relative to the scene, as it is on this machine.

    Separators may be those of Windows. Of a path of the machine that wrote it, absolute or with '..', the longest end
    counts that is there.

    Args:
        there: the name of the file that a path relative to the scene stands for, None where there is none.
        may_leave: a path that leaves the scene, and of which no end is there, is given back, not refused.

    Raises:
        InputError: the path leaves the scene, and no end of it is there; or it cannot be printed.
    """
    given = PureWindowsPath(name)  # knows both kinds of separators, drives and roots
    parts = given.parts[1:] if given.anchor else given.parts
    if not name.isprintable() or (not given.anchor and parts and ".." not in parts):
        name = str(PurePosixPath(check_photo_name(name, source)))
        return there(scene, name) or there(scene, "/".join(parts)) or name
    ends = ("/".join(parts[first:]) for first in range(len(parts)) if ".." not in parts[first:])
    found = next(filter(None, (there(scene, end) for end in ends)), None)
    if may_leave and parts:
        return found or name
    return check_photo_name(name, source) if found is None else found


def _mask_file(scene: Path, frame: dict, name: str, source: Path) -> Path | None:
    """The mask that a frame names; `InputError` where it is not there."""
    path = frame.get("mask_path")
    if path is None:
        return None
    if not isinstance(path, str):
        raise InputError(f"{source}: mask_path of frame '{name}' is not a path: write one, or take it out")
    file = scene / _file_name(scene, path, source)
    if not file.is_file():
        raise InputError(f"{source}: frame '{name}' names the mask {file}, which is not there: bring it back")
    return file


def number_of(values: dict, source: Path, key: str, default: float | None = None) -> float | None:
    """A finite number, or the default where the key is absent."""
    if key not in values:
        return default
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise InputError(f"{source}: {key} is {str(value)[:40]!r}: it must be a finite number")
    return float(value)


def read_camera(
    values: dict, photo: Path, source: Path, lenses: dict[tuple, Lens]
) -> tuple[np.ndarray, tuple[int, int], Lens | None]:
    """[3, 3] float64 intrinsics, (width, height), and the lens where there is distortion, of one frame.

    Args:
        values: those of the frame, before those for all frames.
        lenses: those already made, by their numbers; a new one is added.
    """
    K, size = _intrinsics(values, photo, source)
    number = partial(number_of, values, source)
    model = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") is True else "OPENCV")
    if model not in (*BROWN_MODELS, *FISHEYE_MODELS):
        raise InputError(
            f"{source}: the camera_model of {photo.name} is {str(model)[:40]!r}: known are "
            f"{', '.join((*BROWN_MODELS, *FISHEYE_MODELS))}; convert the capture with ns-process-data, or use its "
            "COLMAP reconstruction"
        )
    fisheye = model in FISHEYE_MODELS
    bends = tuple(number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if unknown := [key for key in ("k5", "k6", *(("p1", "p2") if fisheye else ())) if number(key, 0.0)]:
        raise InputError(
            f"{source}: the {model} camera of {photo.name} has {' and '.join(unknown)}, which the model does not have: "
            "use the capture's COLMAP reconstruction"
        )
    if not (fisheye or any(bends)):
        return K, size, None
    key = (fisheye, size, *K.ravel().tolist(), *bends)
    if key not in lenses:
        lenses[key] = _make_lens(fisheye, size, K, bends, f"{source}: the camera of {photo.name}")
    return lenses[key].K, lenses[key].size, lenses[key]


def _make_lens(fisheye: bool, size: tuple[int, int], K: np.ndarray, bends: tuple[float, ...], owner: str) -> Lens:
    """`bends`: k1, k2, k3, k4, p1, p2."""
    radial, (k1, k2, k3, k4, p1, p2) = bends[:4], bends
    pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    if not fisheye and k4:
        # As nerfstudio has it: COLMAP's models, and OpenCV's own fourth coefficient, are other polynomials.
        return make_lens("OPENCV", size, brown_projection(pinhole[:2], pinhole[2:], radial, p1, p2), owner)
    if fisheye:
        model, params = "OPENCV_FISHEYE", [*pinhole, *radial]
    elif k3:
        model, params = "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    else:
        model, params = "OPENCV", [*pinhole, k1, k2, p1, p2]
    camera = load_pycolmap().Camera(model=model, width=size[0], height=size[1], params=params)
    return lens_of_camera(camera, owner)


def _intrinsics(values: dict, photo: Path, source: Path) -> tuple[np.ndarray, tuple[int, int]]:
    """[3, 3] float64 and (width, height) of one frame's photo, as taken."""
    number = partial(number_of, values, source)
    width, height = number("w"), number("h")
    if width is None or height is None:
        width, height = photo_size(photo)
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(
            f"{source}: the size of {photo.name} is {width:g}x{height:g} pixels: write the photo's as w and h, or take "
            "them out"
        )

    K = pinhole(values, source, (width, height))
    if K is None:
        raise InputError(
            f"{source}: the camera of {photo.name} has neither fl_x nor a camera_angle_x in 0 .. pi: write one of them "
            "there (pixels, radians), or find the cameras anew by 'turbogs reconstruct' on a folder of the photos alone"
        )
    return K, (round(width), round(height))


def pinhole(values: dict, source: Path, size: tuple[float, float], angles: str = "xy") -> np.ndarray | None:
    """[3, 3] float64 intrinsics of one frame; None where nothing gives its horizontal focal length.

    Of `MATRICES` where there is neither ``fl_x`` nor an angle.

    Args:
        values: those of the frame, before those for all frames.
        size: (width, height), in whose middle the principal point is unless it is given.
        angles: axes whose ``camera_angle`` serves where there is no ``fl``.
    """
    focals: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        focal = number_of(values, source, f"fl_{axis}")
        angle = number_of(values, source, f"camera_angle_{axis}") if focal is None and axis in angles else None
        if angle is not None and 0 < angle < math.pi:
            focal = 0.5 * side / math.tan(0.5 * angle)
        focals.append(focals[0] if focal is None and focals else focal)
    if focals[0] is None:
        return next((_matrix(values, key, source) for key in MATRICES if key in values), None)
    x, y = (number_of(values, source, f"c{axis}", 0.5 * side) for axis, side in zip("xy", size, strict=True))
    return np.array([[focals[0], 0.0, x], [0.0, focals[1], y], [0.0, 0.0, 1.0]])


def _matrix(values: dict, key: str, source: Path) -> np.ndarray:
    """[3, 3] float64 of a frame's intrinsics, which are the rows of a matrix, 3x3 or 4x4."""
    what = f"{source}: {key} of {str(values.get('file_path', 'a camera'))[:80]}"
    try:
        K = np.array(values[key], dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        K = np.empty(0)
    if K.shape not in ((3, 3), (4, 4)) or not np.isfinite(K).all():
        raise InputError(f"{what} is {str(values[key])[:40]!r}: it must be 3x3 or 4x4 finite numbers")
    rest = K - np.eye(len(K))
    rest[[0, 1], [0, 1]] = rest[:2, 2] = 0.0
    if not (K[[0, 1], [0, 1]] > 0).all() or abs(rest[0, 1]) > LARGEST_SKEW or np.abs(np.delete(rest, 1)).max() > 1e-6:
        raise InputError(
            f"{what} is {str(values[key])[:80]}: it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], with positive focal "
            "lengths fx and fy"
        )
    return np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])


def opengl_viewmat(matrix: Any, absent: str, wrong: str, remedy: str = "") -> np.ndarray:
    """[4, 4] float64 world to camera, of a camera-to-world matrix in OpenGL's axes.

    Raises:
        InputError: `absent`, where that is no matrix of numbers; `wrong`, what is wrong with it, and `remedy`.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(absent)
    try:
        return viewmat_of_pose(pose[:3, :3] * [1.0, -1.0, -1.0], pose[:3, 3])
    except ValueError as error:
        raise InputError(f"{wrong} {error}{remedy}") from None


def _read_points(scene: Path, name: Any, source: Path) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(name, str):
        raise InputError(f"{source}: ply_file_path is not a path: write one, or take it out")
    path = scene / _file_name(scene, name, source)
    if not path.is_file():
        raise InputError(
            f"{source}: its ply_file_path {path} is not there: bring it back, or take that line out, to begin with "
            "random points"
        )
    vertices = read_vertices(path)
    if not {"x", "y", "z"} <= set(vertices.dtype.names):
        raise InputError(f"{path} has no x, y, z: export it again, or take ply_file_path out of {source.name}")
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = read_colors(path, vertices)
    return points, np.full(points.shape, 128, dtype=np.uint8) if colors is None else colors
