"""Paths of cameras for films: an orbit about the capture's subject, a way through its cameras, or a file's cameras."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbogs_plugin.captures.transforms import number_of, opengl_viewmat, pinhole, read_frames
from turbogs_plugin.captures.undistort import LARGEST_SIDE
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.placement import out_of_nerfstudio, read_json
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import camera_centers, evenly, look_at
from turbogs_plugin.types import Cameras

MOST_KEYS = 24
"""Largest number of a capture's cameras that a path goes through, evenly spread: more would make it jitter."""
MOST_POINTS = 1000
"""Points of a capture that tell in which of nerfstudio's worlds a path is."""
LENS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
"""Keys of a lens in a ``transforms.json``, of a frame or of all."""
SWING = math.pi
"""Largest gap in radians between cameras that surround what they look at; beyond it an orbit swings."""
WIDEST_FILM = 1920
"""Pixels of the longer side of a film from the capture's cameras; a file's cameras have their own size."""


def focus_and_up(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to all lines of sight (least squares), [3], and the mean upward direction, [3], a unit vector.

    Where the lines are parallel, or meet behind the cameras, the point is one unit in front of their mean.
    """
    centers, directions = (value.double().cpu().numpy() for value in (cameras.centers, cameras.directions))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # [C, 3, 3]
    matrix = across.mean(axis=0)
    middle = centers.mean(axis=0)
    ahead = middle + _unit(directions.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    if np.linalg.eigvalsh(matrix)[0] > 1e-3:
        point = np.linalg.solve(matrix, np.einsum("cij,cj->i", across, centers) / len(centers))
        if np.median(((point - centers) * directions).sum(axis=1)) > 0:
            ahead = point
    down = cameras.viewmats[:, 1, :3].double().cpu().numpy().mean(axis=0)
    return ahead, _unit(-down, np.array([0.0, -1.0, 0.0]))


def orbit(cameras: Cameras, frames: int) -> Cameras:
    """A circle about what the cameras look at, at their median height and distance; a swing through the angles that
    they cover, where they do not surround it. It ends where it began.

    Args:
        cameras: of a capture.
        frames: of the film, at least 1.
    """
    focus, up = focus_and_up(cameras)
    centers = cameras.centers.double().cpu().numpy()
    offsets = centers - focus
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    east = _unit(flat.mean(axis=0), _unit(flat[0], np.cross(up, [0.7, 0.1, 0.7])))
    north = np.cross(up, east)
    angles = np.sort(np.arctan2(flat @ north, flat @ east))
    gaps = np.diff(np.append(angles, angles[0] + 2 * math.pi))
    widest = int(gaps.argmax())
    turns = np.arange(frames) / frames
    if gaps[widest] > SWING:  # from the end of the gap around to its beginning
        first, reach = angles[(widest + 1) % len(angles)], 2 * math.pi - gaps[widest]
        course = first + reach * (0.5 - 0.5 * np.cos(2 * math.pi * turns))
    else:
        course = angles[0] + 2 * math.pi * turns
    radius = max(float(np.median(np.linalg.norm(flat, axis=1))), 1e-3)
    places = focus + float(np.median(heights)) * up
    places = places + radius * (np.cos(course)[:, None] * east + np.sin(course)[:, None] * north)
    viewmats = np.stack([look_at(place, focus, up) for place in places])
    K, size = _common_lens(cameras)
    return _cameras(viewmats, K, size)


def through_views(cameras: Cameras, frames: int) -> Cameras:
    """A smooth way through the cameras in their order, at most `MOST_KEYS` of them."""
    chosen = evenly(len(cameras), MOST_KEYS)
    keys = cameras.to("cpu").select(chosen)
    K, size = _common_lens(cameras)
    return interpolated(keys.viewmats.double().numpy(), K, size, frames)


def from_file(path: Path, scene: Scene, frames: int) -> Cameras:
    """A smooth way through the cameras of a file: of the layout of ``transforms.json`` (``w``, ``h``, ``fl_x`` or
    ``camera_angle_x``, of all or of each frame, and a ``transform_matrix`` each, from camera to world, in the capture's
    own coordinates and OpenGL's axes), of nerfstudio's viewer (``camera_path``, in nerfstudio's world if its
    `TRANSFORMS` lies beside the file), or Inria's ``cameras.json``. The film has the first camera's size.

    Raises:
        InputError: no such file, or not such a one.
    """
    content = read_json(path)
    if isinstance(content, list) and content and all(isinstance(entry, dict) for entry in content):
        lenses, poses = _of_inria(content, path)
    elif isinstance(content, dict) and isinstance(content.get("camera_path"), list):
        lenses, poses = _of_nerfstudio(content, path)
    else:
        content, entries = read_frames(path)
        lenses = [{key: each[key] for each in (content, entry) for key in LENS if key in each} for entry in entries]
        poses = [entry.get("transform_matrix") for entry in entries]
    Ks: list[np.ndarray] = []
    size: tuple[int, int] | None = None
    for place, lens in enumerate(lenses):
        width, height = (number_of(lens, path, name) for name in ("w", "h"))
        if not (width and height and 2 <= width <= LARGEST_SIDE and 2 <= height <= LARGEST_SIDE):
            raise InputError(f"{path}: camera {place} has no size of the film: give w and h in pixels")
        K = pinhole(lens, path, (width, height))
        if K is None or K[0, 0] <= 0:
            raise InputError(f"{path}: camera {place} has neither fl_x nor a camera_angle_x in 0 .. pi")
        size = size or (round(width), round(height))
        Ks.append(K * [[size[0] / width], [size[1] / height], [1.0]])
    if size is None:
        raise InputError(f"{path} has no cameras: export the path again")
    viewmats = np.stack(
        [opengl_viewmat(pose, f"{path}: the pose of camera {place}") for place, pose in enumerate(poses)]
    )
    if isinstance(content, dict) and "camera_path" in content and (changes := out_of_nerfstudio(path)):
        points = scene.frame.restore_points(scene.points[evenly(len(scene.points), MOST_POINTS)].cpu().numpy())
        moved, some = [change.apply_to_poses(viewmats) for change in changes], evenly(len(viewmats), MOST_KEYS)
        viewmats = max(moved, key=lambda each: _seen(each[some], np.stack(Ks)[some], points))
    return interpolated(scene.frame.normalise_poses(viewmats), np.stack(Ks), size, frames)


def _seen(viewmats: np.ndarray, Ks: np.ndarray, points: np.ndarray) -> int:
    """How often C cameras, with the principal point in the middle, see one of the points [M, 3]."""
    places = np.einsum("cij,mj->cmi", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]  # [C, M, 3]
    pixels = np.einsum("cij,cmj->cmi", Ks, places / np.maximum(places[:, :, 2:], 1e-9))[:, :, :2]
    return int(((places[:, :, 2] > 0) & (abs(pixels - Ks[:, None, :2, 2]) < Ks[:, None, :2, 2]).all(axis=2)).sum())


def _of_nerfstudio(content: dict[str, Any], path: Path) -> tuple[list[dict[str, Any]], list[Any]]:
    """Lenses, as frames of a ``transforms.json`` have them, and poses of a camera path of nerfstudio's viewer."""
    if content.get("camera_type", "perspective") != "perspective":
        raise InputError(f"{path} is of {str(content['camera_type'])[:40]} cameras: a film takes perspective ones")
    lenses, poses = [], []
    for entry in content["camera_path"]:
        values = entry if isinstance(entry, dict) else {}
        angle = number_of(values, path, "fov")  # degrees, of the height
        width, height = (number_of(content, path, f"render_{side}") for side in ("width", "height"))
        focal = 0.5 * height / math.tan(math.radians(angle) / 2) if height and angle and 0 < angle < 180 else None
        lenses.append({"w": width, "h": height} | ({} if focal is None else {"fl_x": focal}))
        matrix = values.get("camera_to_world")
        poses.append([matrix[row : row + 4] for row in range(0, len(matrix), 4)] if isinstance(matrix, list) else None)
    return lenses, poses


def _of_inria(content: list[dict[str, Any]], path: Path) -> tuple[list[dict[str, Any]], list[Any]]:
    """As `_of_nerfstudio`, of the cameras that Inria's trainer writes: OpenCV's axes, a position and a rotation."""
    names = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy"}
    lenses = [{ours: entry[theirs] for ours, theirs in names.items() if theirs in entry} for entry in content]
    poses = []
    for place, entry in enumerate(content):
        try:
            rotation, position = (np.array(entry[name], dtype=np.float64) for name in ("rotation", "position"))
            poses.append(np.c_[rotation * [1.0, -1.0, -1.0], position])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: camera {place} has no rotation of 3x3 numbers and position") from None
    return lenses, poses


def interpolated(viewmats: np.ndarray, Ks: np.ndarray, size: tuple[int, int], frames: int) -> Cameras:
    """Cameras at even steps of a smooth way through others: centres on a cubic Hermite spline whose tangents are
    central differences, rotations by slerp, intrinsics linearly.

    Args:
        viewmats: [C, 4, 4] float64, world to camera.
        Ks: [C, 3, 3] float64, or [3, 3] of all.
        size: (width, height) of the film.
        frames: at least 1.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.spatial.transform import Rotation, Slerp

    Ks = np.broadcast_to(Ks, (len(viewmats), 3, 3))
    if len(viewmats) == 1:
        return _cameras(np.repeat(viewmats, frames, axis=0), Ks, size)
    centers, rotations = camera_centers(viewmats), Rotation.from_matrix(viewmats[:, :3, :3])
    chords = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = (rotations[1:] * rotations[:-1].inv()).magnitude()
    # Time in proportion to the way makes the speed even; where the cameras share a place, to the angle.
    lengths = chords / max(chords.mean(), 1e-12) + turns / max(turns.mean(), 1e-12) * (chords.mean() < 1e-9)
    times = np.concatenate([[0.0], np.cumsum(np.maximum(lengths, 1e-3))])  # [C]
    wanted = np.linspace(0.0, times[-1], frames)
    places = CubicHermiteSpline(times, centers, np.gradient(centers, times, axis=0))(wanted)  # [F, 3]
    made = np.tile(np.eye(4), (frames, 1, 1))
    made[:, :3, :3] = Slerp(times, rotations)(wanted).as_matrix()
    made[:, :3, 3] = -np.einsum("fij,fj->fi", made[:, :3, :3], places)
    after = np.searchsorted(times, wanted, side="right").clip(1, len(times) - 1)
    share = ((wanted - times[after - 1]) / (times[after] - times[after - 1]))[:, None, None]
    return _cameras(made, (1 - share) * Ks[after - 1] + share * Ks[after], size)


def _common_lens(cameras: Cameras) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics [3, 3] with the picture's middle as principal point, and an even (width, height): the median camera's,
    reduced to `WIDEST_FILM`."""
    order = np.argsort(cameras.sizes.prod(axis=1), kind="stable")
    middle = int(order[len(order) // 2])
    width, height = cameras.sizes[middle].tolist()
    by = min(1.0, WIDEST_FILM / max(width, height))
    size = max(2, 2 * int(by * width / 2)), max(2, 2 * int(by * height / 2))
    K = cameras.Ks[middle].double().cpu().numpy() * by
    return np.array([[K[0, 0], 0, size[0] / 2], [0, K[1, 1], size[1] / 2], [0, 0, 1.0]]), size


def _cameras(viewmats: np.ndarray, Ks: np.ndarray, size: tuple[int, int]) -> Cameras:
    count = len(viewmats)
    lenses = torch.from_numpy(np.broadcast_to(Ks, (count, 3, 3)).copy()).float()
    poses = torch.from_numpy(viewmats).float()
    return Cameras(poses, lenses, np.tile(np.array(size, dtype=np.int64), (count, 1)))


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vector)
    return vector / size if size > 1e-9 else otherwise / np.linalg.norm(otherwise)
