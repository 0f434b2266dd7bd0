"""Photos of three textured planes that meet in a corner, from known cameras: enough for SIFT to reconstruct them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from turbogs_plugin.scene.geometry import look_at

SIZE = (320, 240)
FOCAL = 300.0
EXTENT = 4.0
"""Extent of each plane from the corner."""


def camera_centers(count: int) -> np.ndarray:
    """[count, 3]: on an arc about the corner, at two heights."""
    angles = np.radians(np.linspace(25, 65, count))
    heights = 1.4 + 0.5 * (np.arange(count) % 2)
    return np.stack([4.0 * np.cos(angles), 4.0 * np.sin(angles), heights], axis=1)


def viewmat(center: np.ndarray) -> np.ndarray:
    """[3, 4] world to camera: x right, y down, z forward."""
    return look_at(center, np.array([0.6, 0.6, 0.7]), np.array([0.0, 0.0, 1.0]))[:3]


def render_corner(center: np.ndarray, seed: int = 0) -> Image.Image:
    """The corner as a pinhole camera sees it. Not to be changed."""
    return _render(tuple(center.tolist()), seed)


@cache
def _render(place: tuple[float, float, float], seed: int) -> Image.Image:
    center = np.array(place)
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1) @ viewmat(center)[:, :3]  # [H, W, 3]
    with np.errstate(divide="ignore"):
        depths = np.where(rays < 0, -center / rays, np.inf)  # of the planes x = 0, y = 0, z = 0
    plane = depths.argmin(axis=-1)
    points = center + rays * depths.min(axis=-1)[..., None]
    values = np.zeros(x.shape)
    for axis in range(3):
        texture = _texture(seed + axis)
        places = np.delete(points, axis, axis=-1)[plane == axis] * (len(texture) / EXTENT)
        values[plane == axis] = map_coordinates(texture, places.T, order=1, mode="nearest")
    gray = np.clip(values, 0, 255).astype(np.uint8)
    return Image.fromarray(np.stack([gray, gray, 255 - gray // 2], axis=-1))


def write_photos(folder: Path, count: int, seed: int = 0) -> np.ndarray:
    """Write ``view_00.jpg``, ...; their camera centres, [count, 3]."""
    folder.mkdir(parents=True, exist_ok=True)
    centers = camera_centers(count)
    for view, center in enumerate(centers):
        render_corner(center, seed).save(folder / f"view_{view:02d}.jpg", quality=95)
    return centers


@cache
def _texture(seed: int, size: int = 512) -> np.ndarray:
    """[size, size] blobs of all sizes."""
    generator = np.random.default_rng(seed)
    texture = np.zeros((size, size))
    for cells, weight in ((16, 45.0), (40, 45.0), (100, 40.0)):
        noise = Image.fromarray(generator.standard_normal((cells, cells)).astype(np.float32))
        texture += weight * np.asarray(noise.resize((size, size), Image.Resampling.BICUBIC))
    return texture + 128.0
