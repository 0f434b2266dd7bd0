"""Camera poses as world-to-camera matrices (x right, y down, z forward)."""

from __future__ import annotations

import numpy as np


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """[V, 3] of [V, 4, 4] world to camera."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] float64 world to camera of a camera at `center` with `target` in the middle of its image.

    Args:
        center, target: [3] float64.
        up: [3], not parallel to the view; it points upwards in the image.
    """
    forward = target - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3:] = -viewmat[:3, :3] @ center[:, None]
    return viewmat
