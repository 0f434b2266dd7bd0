"""Photos of lenses with distortion, turned into photos of a pinhole camera in the same place.

COLMAP chooses the pinhole camera: as fine as the photo on its axis, its image the largest that the photo fills. Where a
lens model maps two directions to one pixel, COLMAP's choice shows some of the photo twice: it is shrunk about its
middle until it does not. The map from the pinhole's image to the photo is kept on a lattice, by the lens's projection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from turbogs_plugin.errors import InputError

if TYPE_CHECKING:
    import pycolmap

STRAIGHT_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""COLMAP's camera models that are a pinhole where all their parameters of distortion, if any, are 0."""
WIDEST_ANGLE = math.radians(60.0)
"""Largest angle off the axis in the pinhole image: a fisheye's rim would become a smear."""
LARGEST_GROWTH = 2.0
"""The pinhole image has at most this many times the sides of the photo (COLMAP's `max_scale`)."""
SHARES = np.linspace(1.0, 0.1, 91)
"""Sizes of the pinhole image that are tried, in COLMAP's choice."""
LATTICE = 129
"""Nodes of a map along either side. Between them it is linear: off by less than 0.05 pixels in strong distortion."""
SMALLEST_SHARE = 0.1
"""A pinhole image that covers less of the photo's width or height is not one of a lens."""
LATTICE_EDGE = 0.5
"""Pixels by which a node of the map may leave the photo."""
ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion and the pinhole camera that takes its place.

    Args:
        model: name of the camera model, as COLMAP has it.
        photo_size: (width, height) of the photos that it was calibrated on.
        size: (width, height) of the pinhole's images.
        K: [3, 3] float64, intrinsics of the pinhole.
        sources: [LATTICE, LATTICE, 2] float32: where in the photo the pinhole's image comes from, at nodes that span it
            from edge to edge; x and y are -1 .. 1 from edge to edge of the photo, so photos of any size will do.
    """

    model: str
    photo_size: tuple[int, int]
    size: tuple[int, int]
    K: np.ndarray
    sources: np.ndarray

    def size_of(self, photo_size: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the pinhole's image for photos of another size than those that it was calibrated on."""
        ratios = np.divide(photo_size, self.photo_size)
        width, height = np.floor(np.multiply(self.size, ratios) + 0.5).astype(np.int64).tolist()
        return max(width, 1), max(height, 1)

    def undistort(self, photo: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The pinhole's image, bilinearly.

        Args:
            photo: [h, w, C] uint8, of any size with the proportions of `photo_size`.
            size: (width, height) of the result, with the proportions of the pinhole's.

        Returns:
            [height, width, C] uint8.
        """
        width, height = size
        planes = torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1), dtype=np.float32))[None]
        across, down = _weights(width), _weights(height)
        result = np.empty((height, width, photo.shape[2]), dtype=np.uint8)
        for first in range(0, height, ROWS_AT_ONCE):  # a whole map would take more than the photo
            rows = slice(first, first + ROWS_AT_ONCE)
            lines = _between(self.sources, down[0][rows], down[1][rows, None, None])  # [R, LATTICE, 2]
            grid = _between(lines.transpose(1, 0, 2), across[0], across[1][:, None, None])  # [width, R, 2]
            sources = torch.from_numpy(np.ascontiguousarray(grid.transpose(1, 0, 2)))[None]
            band = F.grid_sample(planes, sources, padding_mode="border", align_corners=False)[0]
            result[rows] = band.add_(0.5).to(torch.uint8).permute(1, 2, 0).numpy()
        return result


def _weights(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """The node before each pixel's centre, int64, and how far on it lies towards the next one, float32."""
    places = (np.arange(pixels) + 0.5) * ((LATTICE - 1) / pixels)
    before = np.minimum(places.astype(np.int64), LATTICE - 2)
    return before, (places - before).astype(np.float32)


def _between(nodes: np.ndarray, before: np.ndarray, share: np.ndarray) -> np.ndarray:
    start = nodes[before]
    return start + share * (nodes[before + 1] - start)


def lens_of_camera(camera: pycolmap.Camera, owner: str) -> Lens | None:
    """The lens of a camera of any of COLMAP's models; None for a pinhole.

    Args:
        owner: names the camera in messages.

    Raises:
        InputError: parameters that are not those of a lens; a panorama, which no pinhole camera can show.
    """
    model, extra = camera.model.name, list(camera.extra_params_idxs())
    if model in STRAIGHT_MODELS and not camera.params[extra].any():
        return None
    if not camera.is_perspective():
        raise InputError(
            f"{owner} is {model}, a panorama: cut it into perspective photos and reconstruct these "
            "(pycolmap's example panorama_sfm.py does both)"
        )
    lens = _lens(model, (camera.width, camera.height), tuple(camera.params.tolist()))
    if lens is None:
        raise InputError(
            f"{owner} is {model} with parameters that are not those of a lens: nothing of its photos can be "
            "undistorted; reconstruct the capture again"
        )
    return lens


@lru_cache(maxsize=64)
def _lens(model: str, photo_size: tuple[int, int], params: tuple[float, ...]) -> Lens | None:
    """The lens of a camera's numbers, which the cameras of many photos share; None where they are not those of one."""
    import pycolmap

    if not np.isfinite(params).all():
        return None
    camera = pycolmap.Camera(model=model, width=photo_size[0], height=photo_size[1], params=params)
    options = pycolmap.UndistortCameraOptions(
        blank_pixels=0.0, max_scale=LARGEST_GROWTH, max_cam_point_norm=math.tan(WIDEST_ANGLE)
    )
    try:
        pinhole = pycolmap.undistort_camera(options, camera)
    except Exception:  # pycolmap raises whatever C++ threw
        return None
    focal = np.array([pinhole.focal_length_x, pinhole.focal_length_y])
    center = np.array([pinhole.principal_point_x, pinhole.principal_point_y])
    whole = np.array([pinhole.width, pinhole.height])
    for share in SHARES:
        size = np.floor(share * whole).astype(np.int64)
        shifted = center - 0.5 * (whole - size)
        if min(size) < 1:
            break
        if (nodes := _nodes(size / focal, -shifted / focal, camera)) is not None:
            K = np.array([[focal[0], 0.0, shifted[0]], [0.0, focal[1], shifted[1]], [0.0, 0.0, 1.0]])
            return Lens(model, photo_size, (int(size[0]), int(size[1])), K, nodes)
    return None


def _nodes(extent: np.ndarray, corner: np.ndarray, camera: pycolmap.Camera) -> np.ndarray | None:
    """`Lens.sources` of a pinhole image; None where the photo does not fill it, or shows some of it mirrored.

    Args:
        extent, corner: [2] width and height of the image, and its corner at the top left, at depth 1.
        camera: of the photo.
    """
    sides = (camera.width, camera.height)
    x, y = (np.linspace(corner[axis], corner[axis] + extent[axis], LATTICE) for axis in (0, 1))
    with np.errstate(all="ignore"):
        points = np.stack([*np.meshgrid(x, y), np.ones((LATTICE, LATTICE))], axis=-1)
        nodes = camera.img_from_cam(points.reshape(-1, 3))  # NaN where there is none
        least, most = nodes.min(axis=0), nodes.max(axis=0)  # NaN fits nowhere
        fits = (least >= -LATTICE_EDGE) & (most <= np.add(sides, LATTICE_EDGE))
        fits &= most - least >= np.multiply(SMALLEST_SHARE, sides)
        nodes = nodes.reshape(LATTICE, LATTICE, 2)
        right, down = nodes[:-1, 1:] - nodes[:-1, :-1], nodes[1:, :-1] - nodes[:-1, :-1]
        upright = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
    return (2.0 * nodes / sides - 1.0).astype(np.float32) if fits.all() and upright.all() else None


def undistortion_note(lenses: Sequence[Lens | None]) -> str:
    """One line on the photos of these lenses, one each, that were undistorted; empty where none was."""
    if not (bent := [lens for lens in lenses if lens is not None]):
        return ""
    different = {id(lens): lens for lens in bent}
    first = bent[0]
    photo, image = ("x".join(map(str, size)) for size in (first.photo_size, first.size))
    more = f", and {len(different) - 1} more cameras" if len(different) > 1 else ""
    return f"{len(bent)} photos undistorted: {first.model} {photo} -> PINHOLE {image}{more}"
