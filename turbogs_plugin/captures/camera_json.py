"""Cameras as nerfstudio, instant-ngp and Blender write them in JSON: OpenGL's axes (x right, y up, z backward)."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import LARGEST_SIDE, text_of
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.decoding import photo_size
from turbogs_plugin.captures.undistort import Lens, lens_of_camera
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import viewmat_of_pose
from turbogs_plugin.yaml_json import parse_json, require_json_size

BROWN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
"""Names of one model, whose missing coefficients are 0."""
FISHEYE = "OPENCV_FISHEYE"
FOR_ALL = (
    *("camera_model", "is_fisheye", "w", "h", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "mask_path"),
    *("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "integer_depth_scale"),
)
"""Keys of a file that hold for each frame without a value of its own."""


def read_frames(source: Path, key: str = "frames") -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A transforms file, and its frames under a key. Raises `InputError` unless it is JSON with a list of frames."""
    require_json_size(source)
    content = parse_json(text_of(source), str(source))
    frames = content.get(key) if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source} has no list of {key}: export it again")
    return given(content), [given(frame) for frame in frames]


def given(values: dict[str, Any]) -> dict[str, Any]:
    """The entries but for null and empty texts, which other writers have for what is absent."""
    return {key: value for key, value in values.items() if value is not None and value != ""}


def number_of(values: dict, source: Path, key: str, default: float | None = None) -> float | None:
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


def read_camera(values: dict[str, Any], photo: Path, source: Path) -> tuple[np.ndarray, tuple[int, int], Lens | None]:
    """[3, 3] float64 intrinsics, (width, height), and the lens where there is distortion, of one frame.

    Args:
        values: the frame's own, before the file's for all frames.
    """
    number, owner = partial(number_of, values, source), f"{source}: the camera of {photo.name}"
    width, height = number("w"), number("h")
    if width is None or height is None:
        width, height = photo_size(photo)
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"{owner} is {width:g}x{height:g} pixels: write the photo's size as w and h, or take them out")
    K, size = pinhole(values, source, (width, height)), (round(width), round(height))
    if K is None:
        raise InputError(
            f"{owner} has neither fl_x nor a camera_angle_x in 0 .. pi: write one of them there (pixels, radians), or "
            "find the cameras anew by 'turbogs reconstruct' on a folder of the photos alone"
        )
    fisheye = str(values.get("is_fisheye")).lower() in ("true", "1")
    model = str(values.get("camera_model", FISHEYE if fisheye else "OPENCV")).upper()
    if model not in (*BROWN_MODELS, FISHEYE):
        raise InputError(
            f"{owner} is a {model[:40]!r}: known are {', '.join((*BROWN_MODELS, FISHEYE))}; convert the capture "
            "with ns-process-data, or use its COLMAP reconstruction"
        )
    bends = {key: number(key, 0.0) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    known = ("k1", "k2", "k3", "k4") if model == FISHEYE else ("k1", "k2", "k3", "p1", "p2")
    if unknown := [key for key, value in bends.items() if value and key not in known]:
        raise InputError(
            f"{owner} has {' and '.join(unknown)}, which {model} does not have: use the capture's COLMAP reconstruction"
        )
    if model != FISHEYE and not any(bends.values()):
        return K, size, None
    k1, k2, k3, k4, p1, p2 = (bends[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    kind, coefficients = ("FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) if k3 else ("OPENCV", [k1, k2, p1, p2])
    if model == FISHEYE:
        kind, coefficients = FISHEYE, [k1, k2, k3, k4]
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients]
    lens = lens_of_camera(load_pycolmap().Camera(model=kind, width=size[0], height=size[1], params=params), owner)
    return (K, size, None) if lens is None else (lens.K, lens.size, lens)


def pinhole(values: dict, source: Path, size: tuple[float, float]) -> np.ndarray | None:
    """[3, 3] float64 intrinsics of one frame; None where nothing gives its horizontal focal length.

    Args:
        values: the frame's own, before the file's for all frames.
        size: (width, height), in whose middle the principal point is unless it is given.
    """
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
    the matrix be transposed, where its last column says so.

    Raises:
        InputError: it is no matrix of 4x4 finite numbers, or no rotation and translation; `owner` names it.
    """
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
