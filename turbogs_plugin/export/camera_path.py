"""Paths of cameras for films: an orbit about what the capture shows, a way through its cameras, or a file's cameras."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.captures.camera_json import number_of, opengl_viewmat, pinhole, read_frames
from turbogs_plugin.captures.capture import LARGEST_SIDE
from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.geometry import camera_centers, evenly, look_at, quaternions
from turbogs_plugin.types import Cameras

MOST_KEYS = 24
"""Cameras of a capture that a path goes through, evenly spread: more would make it jitter."""
SWING = math.pi
"""Cameras that leave a gap of more than this angle about what they look at do not surround it: an orbit swings."""
WIDEST_FILM = 1920
"""Pixels of the longer side of a film from the capture's cameras; a file's cameras have their own size."""


def focus_and_up(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """[3] the point nearest to all lines of sight (least squares), and [3] the mean upward direction, a unit vector.

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
    return _cameras(viewmats, np.repeat(K[None], frames, axis=0), size)


def through_views(cameras: Cameras, frames: int) -> Cameras:
    """A smooth way through the cameras in their order, at most `MOST_KEYS` of them."""
    chosen = evenly(len(cameras), MOST_KEYS)
    keys = cameras.to("cpu").select(chosen)
    K, size = _common_lens(cameras)
    return interpolated(keys.viewmats.double().numpy(), np.repeat(K[None], len(chosen), axis=0), size, frames)


def from_file(path: Path, frame: Frame, frames: int) -> Cameras:
    """A smooth way through the cameras of a file in the layout of ``transforms.json``: ``w``, ``h``, ``fl_x`` (or
    ``camera_angle_x``), ``frames`` with a ``transform_matrix`` each, from camera to world, in the capture's own
    coordinates and OpenGL's axes. The focal length may change from frame to frame, the size may not.

    Raises:
        InputError: no such file, or not such a one.
    """
    content, entries = read_frames(path)
    number = partial(number_of, content, path)
    width, height = (number(name) for name in ("w", "h"))
    if not (width and height and 2 <= width <= LARGEST_SIDE and 2 <= height <= LARGEST_SIDE):
        raise InputError(f"{path} has no size of the film: give w and h in pixels")
    viewmats, Ks = [], []
    for place, entry in enumerate(entries):
        values = {**content, **entry}
        K = pinhole(values, path, (width, height), angles="x")
        if K is None or K[0, 0] <= 0:
            raise InputError(f"{path}: camera {place} has neither fl_x nor a camera_angle_x in 0 .. pi")
        Ks.append(K)
        owner = f"{path}: the transform_matrix of camera {place}"
        viewmats.append(opengl_viewmat(entry.get("transform_matrix"), f"{owner} is no matrix of 4x4 numbers", owner))
    normalised = frame.normalise_poses(np.stack(viewmats))
    return interpolated(normalised, np.array(Ks), (round(width), round(height)), frames)


def interpolated(viewmats: np.ndarray, Ks: np.ndarray, size: tuple[int, int], frames: int) -> Cameras:
    """Cameras at even steps of a smooth way through others: centres on a Catmull-Rom spline (centripetal, so without
    loops), rotations by slerp, intrinsics by lines.

    Args:
        viewmats: [C, 4, 4] float64, world to camera.
        Ks: [C, 3, 3] float64.
        size: (width, height) of the film.
        frames: at least 1.
    """
    centers, quats = camera_centers(viewmats), quaternions(viewmats[:, :3, :3])
    if len(centers) == 1:
        return _cameras(np.repeat(viewmats, frames, axis=0), np.repeat(Ks, frames, axis=0), size)
    chords = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = 2 * np.arccos(np.abs((quats[1:] * quats[:-1]).sum(axis=1)).clip(0, 1))
    lengths = chords / max(chords.mean(), 1e-12) + turns / max(turns.mean(), 1e-12) * (chords.mean() < 1e-9)
    times = np.concatenate([[0.0], np.cumsum(np.maximum(lengths, 1e-3))])  # of the keys: even speed
    wanted = np.linspace(0.0, times[-1], frames)
    left = np.searchsorted(times, wanted, side="right").clip(1, len(times) - 1) - 1
    share = (wanted - times[left]) / (times[left + 1] - times[left])  # [F]
    places = _catmull_rom(centers, left, share)
    made = np.tile(np.eye(4), (frames, 1, 1))
    turned = _slerp(quats[left], quats[left + 1], share)
    made[:, :3, :3] = rotation_matrices(torch.from_numpy(turned)).numpy()
    made[:, :3, 3] = -np.einsum("fij,fj->fi", made[:, :3, :3], places)
    between = Ks[left] + share[:, None, None] * (Ks[left + 1] - Ks[left])
    return _cameras(made, between, size)


def _slerp(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[F, 4] between unit quaternions [F, 4], on the shorter way."""
    cosine = (first * second).sum(axis=1)
    second = np.where(cosine[:, None] < 0, -second, second)
    angle = np.arccos(np.abs(cosine).clip(0, 1))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    a = np.where(small, 1 - share, np.sin((1 - share) * angle) / sine)
    b = np.where(small, share, np.sin(share * angle) / sine)
    mixed = a[:, None] * first + b[:, None] * second
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def _catmull_rom(points: np.ndarray, left: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[F, 3] on the centripetal Catmull-Rom spline (Barry and Goldman 1988) through points [C, 3]: behind point `left`
    [F], by `share` [F] of the way to the next. At both ends the last chord is repeated."""
    ends = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    p = [ends[left + place] for place in range(4)]
    steps = [np.maximum(np.linalg.norm(p[i + 1] - p[i], axis=1) ** 0.5, 1e-9) for i in range(3)]
    t = np.cumsum([np.zeros_like(share), *steps], axis=0)  # [4, F]
    at = t[1] + share * (t[2] - t[1])

    def mix(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        part = ((at - low) / (high - low))[:, None]
        return a + part * (b - a)

    q = [mix(p[i], p[i + 1], t[i], t[i + 1]) for i in range(3)]
    r = [mix(q[i], q[i + 1], t[i], t[i + 2]) for i in range(2)]
    return mix(r[0], r[1], t[1], t[2])


def _common_lens(cameras: Cameras) -> tuple[np.ndarray, tuple[int, int]]:
    """[3, 3] intrinsics with the picture's middle as principal point, and an even (width, height): the median camera's,
    reduced to `WIDEST_FILM`."""
    order = np.argsort(cameras.sizes.prod(axis=1), kind="stable")
    middle = int(order[len(order) // 2])
    width, height = cameras.sizes[middle].tolist()
    by = min(1.0, WIDEST_FILM / max(width, height))
    size = tuple(max(2, 2 * int(by * side / 2)) for side in (width, height))
    K = cameras.Ks[middle].double().cpu().numpy() * by
    return np.array([[K[0, 0], 0, size[0] / 2], [0, K[1, 1], size[1] / 2], [0, 0, 1.0]]), size


def _cameras(viewmats: np.ndarray, Ks: np.ndarray, size: tuple[int, int]) -> Cameras:
    tensors = (torch.from_numpy(np.ascontiguousarray(value)).float() for value in (viewmats, Ks))
    return Cameras(*tensors, np.tile(np.array(size, dtype=np.int64), (len(viewmats), 1)))


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vector)
    return vector / size if size > 1e-9 else otherwise / np.linalg.norm(otherwise)
