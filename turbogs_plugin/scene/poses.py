"""Camera poses as world-to-camera matrices (x right, y down, z forward)."""

from __future__ import annotations

import numpy as np

LARGEST_DEVIATION = 1e-2
"""Axes whose products differ from those of a rotation by more are refused."""


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """[V, 3] of [V, 4, 4] world to camera."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of `count` views, evenly spread, ascending; with the first and the last where there are two."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def viewmat_of_pose(axes: np.ndarray, center: np.ndarray) -> np.ndarray:
    """[4, 4] float64 world to camera of a camera's place in the world.

    Args:
        axes: [3, 3] float64, whose columns are the camera's axes in the world: right, down, forward. Decimals that were
            cut when it was written are made up for: the nearest rotation is taken.
        center: [3] float64.

    Raises:
        ValueError: the numbers are not finite, or the axes not a rotation.
    """
    if not (np.isfinite(axes).all() and np.isfinite(center).all()):
        raise ValueError("has numbers that are not finite")
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.abs(axes.T @ axes - np.eye(3)).max() < LARGEST_DEVIATION or np.linalg.det(axes) < 0:
            raise ValueError("is not a rotation and a translation")
        left, _, right = np.linalg.svd(axes)
        viewmat = np.eye(4)
        viewmat[:3, :3] = (left @ right).T
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return viewmat


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


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """[C, 4] wxyz of rotations [C, 3, 3]: the largest component first (Shepperd 1978)."""
    found = []
    for m in matrices:
        squares = [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
        signs, sums = m - m.T, m + m.T
        table = [
            [squares[0], signs[2, 1], signs[0, 2], signs[1, 0]],
            [signs[2, 1], squares[1], sums[0, 1], sums[0, 2]],
            [signs[0, 2], sums[0, 1], squares[2], sums[1, 2]],
            [signs[1, 0], sums[0, 2], sums[1, 2], squares[3]],
        ]
        row = np.array(table[np.argmax(squares)])
        found.append(row / np.linalg.norm(row))
    return np.stack(found)
