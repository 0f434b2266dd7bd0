"""Cameras as nerfstudio, instant-ngp and Blender write them in JSON: OpenGL's axes (x right, y up, z backward)."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import LARGEST_SIDE
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.undistort import Lens, brown_projection, lens_of_camera
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import viewmat_of_pose

BROWN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
"""Names of one model, whose missing coefficients are 0."""
FISHEYE_MODELS = ("OPENCV_FISHEYE",)
MATRICES = ("K", "intrinsic_matrix")
"""Keys of intrinsics as a matrix, of which NeuS2 writes the second."""
LARGEST_SKEW = 0.5
"""Largest entry [0, 1] of a matrix of intrinsics, in pixels, that counts as none: decompositions leave a small one."""


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
        values: the frame's own, before the file's for all frames.
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
    bends = tuple(number(key, 0.0) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
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
    k1, k2, k3, k4, p1, p2 = bends
    pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    model, params = "OPENCV", [*pinhole, k1, k2, p1, p2]
    if fisheye:
        model, params = "OPENCV_FISHEYE", [*pinhole, *bends[:4]]
    elif k3 or k4:
        model, params = "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    camera = load_pycolmap().Camera(model=model, width=size[0], height=size[1], params=params)
    # As nerfstudio has it: COLMAP's models, and OpenCV's own fourth coefficient, are other polynomials.
    fourth = None if fisheye or not k4 else brown_projection(pinhole[:2], pinhole[2:], bends[:4], p1, p2)
    return lens_of_camera(camera, owner, fourth)


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
        values: the frame's own, before the file's for all frames.
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
