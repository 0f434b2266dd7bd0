"""Photos with points painted at pixels that a test computed, and what a loaded scene makes of them."""

from __future__ import annotations

import numpy as np

from turbogs_plugin.scene import PosedImages, Scene

COLORS = ((255, 40, 40), (40, 255, 40), (40, 40, 255))
"""Colours of the painted points; nothing else in a photo may have them."""


def axes_of(backward: np.ndarray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """[3, 3] rows right, up and backward of a camera of OpenGL's. backward: [3], of length 1."""
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward])


def seen_by(
    axes: np.ndarray, center: np.ndarray, points: np.ndarray, focal: float, size: tuple[int, int]
) -> np.ndarray:
    """[N, 2] where such a camera sees points [N, 3]: y of the image points down, y of the camera up."""
    across, along, behind = axes @ (points - center).T
    return np.stack([0.5 * size[0] - focal * across / behind, 0.5 * size[1] + focal * along / behind], axis=1)


def painted_photo(size: tuple[int, int], pixels: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8, black but for a pixel a point; [3, 2] image coordinates (x, y), the centre of the first pixel at
    (0.5, 0.5)."""
    width, height = size
    photo = np.zeros((height, width, 3), dtype=np.uint8)
    for color, (x, y) in zip(COLORS, np.floor(pixels).astype(int), strict=True):
        assert 0 <= x < width and 0 <= y < height and not photo[y, x].any(), "the test paints beside the photo"
        photo[y, x] = color
    return photo


def require_points_at_their_pixels(scene: Scene, views: PosedImages, points: np.ndarray) -> None:
    """Each point [3, 3], in the capture's own coordinates, projected by each loaded camera, lies within the pixel that
    has its colour in the loaded photo."""
    normalised = scene.frame.normalise_points(points)
    for view in range(len(views)):
        viewmat, K = (array[view].double().numpy() for array in (views.cameras.viewmats, views.cameras.Ks))
        in_camera = normalised @ viewmat[:3, :3].T + viewmat[:3, 3]  # [3, 3]
        assert (in_camera[:, 2] > 0).all()
        projected = (in_camera @ K.T)[:, :2] / in_camera[:, 2:]
        photo = (views.photos.image(view) * 255).round().numpy()
        for color, (x, y) in zip(COLORS, projected, strict=True):
            (row,), (column,) = np.nonzero((photo == color).all(axis=2))  # of one pixel
            assert abs(column + 0.5 - x) < 0.501 and abs(row + 0.5 - y) < 0.501, views.names[view]
