"""Paths of cameras for films: an orbit about the capture's subject, a way through its cameras, or a file's cameras."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbogs_plugin.captures.capture import text_of
from turbogs_plugin.captures.transforms import number_of, opengl_viewmat, pinhole, read_frames
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.placement import out_of_nerfstudio
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import camera_centers, evenly, look_at, seen
from turbogs_plugin.types import Cameras
from turbogs_plugin.viewer.camera import focus_and_up
from turbogs_plugin.yaml_json import parse_json

MOST_KEYS = 24
"""Largest number of a capture's cameras that a path goes through, evenly spread: more would make it jitter."""
SWING = math.pi
"""Largest gap in radians between cameras that surround what they look at; beyond it an orbit swings."""
WIDEST_FILM, LARGEST_FILM = 1920, 4096
"""Pixels of the longer side of a film from the capture's cameras, and of any film: more takes minutes and gigabytes."""


def orbit(cameras: Cameras, frames: int) -> Cameras:
    """`frames` cameras on a circle about what a capture's cameras look at, at their median height and distance; a swing
    through the angles that they cover, where they do not surround it. It ends where it began."""
    focus, up = focus_and_up(cameras)
    offsets = cameras.centers.double().cpu().numpy() - focus
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    east = np.linalg.svd(up[None])[2][1]  # across `up`
    north = np.cross(up, east)
    angles = np.sort(np.arctan2(flat @ north, flat @ east))
    gaps = np.diff(angles, append=angles[0] + 2 * math.pi)
    widest, turns = int(gaps.argmax()), 2 * math.pi * np.arange(frames) / frames
    if gaps[widest] > SWING:  # from the end of the gap around to its beginning, and back
        turns = (2 * math.pi - gaps[widest]) * (0.5 - 0.5 * np.cos(turns))
    course = angles[widest + 1 - len(angles)] + turns
    radius = max(float(np.median(np.linalg.norm(flat, axis=1))), 1e-3)
    ring = radius * (np.cos(course)[:, None] * east + np.sin(course)[:, None] * north)
    places = focus + float(np.median(heights)) * up + ring
    return _cameras(np.stack([look_at(place, focus, up) for place in places]), *_common_lens(cameras))


def through_views(cameras: Cameras, frames: int) -> Cameras:
    """A smooth way through the cameras in their order, at most `MOST_KEYS` of them."""
    keys = cameras.viewmats[evenly(len(cameras), MOST_KEYS)].double().cpu().numpy()
    return interpolated(keys, *_common_lens(cameras), frames)


def from_file(path: Path, scene: Scene, frames: int) -> Cameras:
    """A smooth way through the cameras of a file; the film has the first one's size.

    The file is of the layout of ``transforms.json`` (``w``, ``h``, ``fl_x`` or ``camera_angle_x``, of all or of each
    frame, and a ``transform_matrix`` each, from camera to world, in the capture's own coordinates and OpenGL's axes),
    of nerfstudio's viewer (``camera_path``, in nerfstudio's world if its `TRANSFORMS` lies beside the file), or Inria's
    ``cameras.json``. Raises `InputError` where it is none of these."""
    content, changes = parse_json(text_of(path), str(path)), [Similarity(np.eye(3), 1.0, np.zeros(3))]
    if isinstance(content, list) and content and all(isinstance(entry, dict) for entry in content):
        entries = [_of_inria(entry, f"{path}: camera {place}") for place, entry in enumerate(content)]
    elif isinstance(content, dict) and isinstance(content.get("camera_path"), list):
        entries, changes = _of_nerfstudio(content, path), out_of_nerfstudio(path) or changes
    else:
        shared, own = read_frames(path)
        entries = [shared | entry for entry in own]
    if not entries:
        raise InputError(f"{path} has no cameras: export the path again")
    cameras = [_camera(entry, path, place) for place, entry in enumerate(entries)]
    viewmats, Ks, sizes = (np.stack(each) for each in zip(*cameras, strict=True))
    Ks[:, :2] *= (sizes[0] / sizes)[:, :, None]
    points, some = scene.points[evenly(len(scene.points), 1000)].cpu().numpy(), evenly(len(viewmats), MOST_KEYS)
    moved = [Similarity.into(scene.frame).after(change).apply_to_poses(viewmats) for change in changes]
    best = max(moved, key=lambda each: sum(len(seen(points, each[i], Ks[i], sizes[0])[0]) for i in some))
    return interpolated(best, Ks, sizes[0], frames)


def _camera(values: dict[str, Any], path: Path, place: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World to camera [4, 4], intrinsics [3, 3] and (width, height) [2] of a frame as ``transforms.json`` has it."""
    owner = f"{path}: camera {place}"
    size = [number_of(values, path, name) or 0.0 for name in ("w", "h")]
    if not all(2 <= side <= LARGEST_FILM for side in size):
        raise InputError(f"{owner} has no size of the film: give w and h in pixels, 2 .. {LARGEST_FILM}")
    K = pinhole(values, path, (size[0], size[1]))
    if K is None or K[0, 0] <= 0:
        raise InputError(f"{owner} has neither fl_x nor a camera_angle_x in 0 .. pi")
    return opengl_viewmat(values.get("transform_matrix"), f"{path}: the pose of camera {place}"), K, np.array(size)


def _of_nerfstudio(content: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """The cameras of a path of nerfstudio's viewer, as frames of a ``transforms.json``."""
    if content.get("camera_type", "perspective") != "perspective":
        raise InputError(f"{path} is of {str(content['camera_type'])[:40]} cameras: a film takes perspective ones")
    width, height = (number_of(content, path, f"render_{side}") for side in ("width", "height"))
    frames = []
    for entry in content["camera_path"]:
        values = entry if isinstance(entry, dict) else {}
        angle = number_of(values, path, "fov") or 0.0  # degrees, of the height
        focal = 0.5 * height / math.tan(math.radians(angle) / 2) if height and 0 < angle < 180 else None
        frame = {"w": width, "h": height, "fl_x": focal, "transform_matrix": values.get("camera_to_world")}
        frames.append({name: value for name, value in frame.items() if value is not None})
    return frames


def _of_inria(entry: dict[str, Any], owner: str) -> dict[str, Any]:
    """A camera as Inria's trainer writes it (OpenCV's axes, a position and a rotation), as a ``transforms.json``'s."""
    names = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy"}
    try:
        rotation, position = (np.array(entry[name], dtype=np.float64) for name in ("rotation", "position"))
        pose = np.c_[rotation * [1.0, -1.0, -1.0], position]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{owner} has no rotation of 3x3 numbers and position") from None
    return {ours: entry[theirs] for ours, theirs in names.items() if theirs in entry} | {"transform_matrix": pose}


def interpolated(viewmats: np.ndarray, Ks: np.ndarray, size: np.ndarray, frames: int) -> Cameras:
    """`frames` cameras at even steps of a smooth way through others: centres on a cubic Hermite spline whose tangents
    are central differences, rotations by slerp, intrinsics linearly.

    Args:
        viewmats: [C, 4, 4] float64, world to camera.
        Ks: [C, 3, 3] float64, or [3, 3] of all.
        size: (width, height) of the film.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.spatial.transform import Rotation, Slerp

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
    lenses = np.broadcast_to(Ks, (len(viewmats), 3, 3)).reshape(-1, 9)
    between = np.stack([np.interp(wanted, times, column) for column in lenses.T], axis=1)
    return _cameras(made, between.reshape(-1, 3, 3), size)


def resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """Cameras for pictures of another size, by its height: at the sides something is cut off, or more is seen."""
    by = height / torch.from_numpy(cameras.sizes[:, 1])
    Ks = cameras.Ks * torch.stack((by, by, torch.ones_like(by)), dim=1)[:, :, None].to(cameras.Ks)
    Ks[:, 0, 2] += ((width - by * torch.from_numpy(cameras.sizes[:, 0])) / 2).to(Ks)
    return Cameras(cameras.viewmats, Ks, np.tile(np.array([width, height]), (len(cameras), 1)))


def _common_lens(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] with the picture's middle as principal point, and an even (width, height): the median camera's,
    reduced to `WIDEST_FILM`."""
    order = np.argsort(cameras.sizes.prod(axis=1), kind="stable")
    middle = int(order[len(order) // 2])
    by = min(1.0, WIDEST_FILM / cameras.sizes[middle].max())
    size = np.maximum(2, 2 * (by * cameras.sizes[middle] / 2).astype(np.int64))
    K = cameras.Ks[middle].double().cpu().numpy() * by
    return np.array([[K[0, 0], 0, size[0] / 2], [0, K[1, 1], size[1] / 2], [0, 0, 1.0]]), size


def _cameras(viewmats: np.ndarray, Ks: np.ndarray, size: np.ndarray) -> Cameras:
    lenses, sizes = np.broadcast_to(Ks, (len(viewmats), 3, 3)).copy(), np.tile(np.rint(size), (len(viewmats), 1))
    return Cameras(torch.from_numpy(viewmats).float(), torch.from_numpy(lenses).float(), sizes.astype(np.int64))
