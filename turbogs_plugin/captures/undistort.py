"""Photos of lenses with distortion, turned into photos of a pinhole camera in the same place, by COLMAP.

COLMAP chooses the pinhole camera: as fine as the photo on its axis, its image the largest that the photo fills.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.agreement import off_middle

if TYPE_CHECKING:
    import pycolmap

LARGEST_SIDE = 65535  # most pixels of a photo's width or height: JPEG's own limit
STRAIGHT_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""COLMAP's camera models that are a pinhole where all their parameters of distortion, if any, are 0."""
WIDEST = math.tan(math.radians(60.0))  # of the largest angle off the axis: a fisheye's rim would become a smear
LARGEST_GROWTH = 2.0  # most that the pinhole image has of the photo's sides (COLMAP's `max_scale`)
GRID = 129  # places along either side of a pinhole image at which it is checked against the photo
SMALLEST_SHARE = 0.1  # a pinhole image that covers less of the photo's width or height is not one of a lens
EDGE = 0.5  # pixels by which the border of the pinhole image may leave the photo
PANORAMA_REMEDY = "cut it into perspective photos and reconstruct these (pycolmap's example panorama_sfm.py does both)"


def load_pycolmap() -> ModuleType:
    """The module, loaded where it is used: other captures need neither its time nor its presence. SIGTERM keeps the
    handler that Python knows of: pycolmap brings one that prints a trace of C++."""
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion, and the pinhole camera that takes its place."""

    camera: pycolmap.Camera
    size: tuple[int, int]  # (width, height) of the pinhole's images
    K: np.ndarray  # [3, 3] float64, intrinsics of the pinhole

    @property
    def photo_size(self) -> tuple[int, int]:
        """(width, height) of the photos that it was calibrated on."""
        return self.camera.width, self.camera.height

    def undistort(self, photo: Image.Image) -> Image.Image:
        """The pinhole's image, of `size`. Photos of another size than `photo_size` get that first."""
        pycolmap = load_pycolmap()
        if photo.size != self.photo_size:
            photo = photo.resize(self.photo_size, Image.Resampling.BILINEAR)
        planes, made = np.asarray(photo).reshape(photo.height, photo.width, -1), []
        for part in (planes[..., :3], planes[..., 3:]):  # COLMAP knows no alpha
            if part.shape[2]:
                bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(part))
                image, _ = pycolmap.undistort_image(_options(), bitmap, self.camera)
                made.append(image.to_array().reshape(*self.size[::-1], -1))
        return Image.frombytes(photo.mode, self.size, np.concatenate(made, axis=2).tobytes())


def pinhole_of_camera(camera: pycolmap.Camera, owner: str) -> tuple[np.ndarray, tuple[int, int], Lens | None]:
    """The pinhole that takes the place of a camera of any of COLMAP's models: [3, 3] float64 intrinsics, (width,
    height), and the lens; None for a camera that is a pinhole, or has an impossible size, which `Capture.checked`
    refuses. Raises `InputError` for a panorama, which no pinhole camera can show, and for parameters that are not those
    of a lens within the photo, or of another size; `owner` names the camera."""
    model, size = camera.model.name, (camera.width, camera.height)
    bent = model not in STRAIGHT_MODELS or camera.params[list(camera.extra_params_idxs())].any()
    if not bent or max(size) > LARGEST_SIDE:
        return camera.calibration_matrix(), size, None
    if not camera.is_perspective():
        raise InputError(f"{owner} is {model}, a panorama: {PANORAMA_REMEDY}")
    if (lens := _lens(model, size, tuple(camera.params.tolist()))) is None:
        trouble = "with parameters that are not those of a lens, or whose image folds within the photo"
        trouble += ": reconstruct the capture again, with the model OPENCV_FISHEYE for a wide lens"
        other_size = off_middle(camera.params[list(camera.principal_point_idxs())] / size)
        raise InputError(f"{owner}: {other_size}" if other_size else f"{owner} is {model} {trouble}")
    return lens.K, lens.size, lens


@lru_cache(maxsize=64)
def _lens(model: str, size: tuple[int, int], params: tuple[float, ...]) -> Lens | None:
    """The lens of a camera's numbers, which the cameras of many photos share; None where they are not those of one: the
    photo does not fill the pinhole image, or shows some of it mirrored."""
    pycolmap = load_pycolmap()
    if not np.isfinite(params).all():
        return None
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    try:
        pinhole = pycolmap.undistort_camera(_options(), camera)
    except Exception:  # pycolmap raises whatever C++ threw
        return None
    lens = Lens(camera, (pinhole.width, pinhole.height), pinhole.calibration_matrix())
    K, (x, y) = lens.K, (np.linspace(0.0, side, GRID) for side in lens.size)
    rays = np.stack([*np.meshgrid((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]), np.ones((GRID, GRID))], axis=-1)
    with np.errstate(all="ignore"):
        places = np.asarray(camera.img_from_cam(rays.reshape(-1, 3)))  # NaN where there is none
        least, most = places.min(axis=0), places.max(axis=0)  # NaN fits nowhere
        fits = (least >= -EDGE) & (most <= np.add(size, EDGE)) & (most - least >= np.multiply(SMALLEST_SHARE, size))
        places = places.reshape(GRID, GRID, 2)
        right, down = places[:-1, 1:] - places[:-1, :-1], places[1:, :-1] - places[:-1, :-1]
        upright = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
    return lens if fits.all() and upright.all() else None


def _options() -> pycolmap.UndistortCameraOptions:
    return load_pycolmap().UndistortCameraOptions(blank_pixels=0.0, max_scale=LARGEST_GROWTH, max_cam_point_norm=WIDEST)


def undistortion_note(lenses: Sequence[Lens | None]) -> str:
    """One line on the photos of these lenses, one each, that were undistorted; empty where none was."""
    if not (bent := [lens for lens in lenses if lens is not None]):
        return ""
    first, others = bent[0], len(set(map(id, bent))) - 1
    photo, image = ("x".join(map(str, size)) for size in (first.photo_size, first.size))
    more = f", and {others} more cameras" if others else ""
    return f"{len(bent)} photos undistorted: {first.camera.model.name} {photo} -> PINHOLE {image}{more}"
