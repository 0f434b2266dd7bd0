"""Geometry of cameras (world-to-camera matrices: x right, y down, z forward) and of points."""

from __future__ import annotations

import numpy as np
from torch import Tensor

LARGEST_DEVIATION = 1e-2
"""Largest deviation of axes' products from a rotation's."""


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """[V, 3] of [V, 4, 4] world to camera."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of `count` views, evenly spread, ascending; with the first and the last where there are two."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()


def viewmat_of_pose(axes: np.ndarray, center: np.ndarray) -> np.ndarray:
    """[4, 4] float64 world to camera of a camera's place `center` [3] in the world, and its axes there, right, down,
    forward: the columns of `axes` [3, 3]. Decimals that were cut when they were written are made up for: the nearest
    rotation is taken. Raises `ValueError` for numbers that are not finite, and axes that are no rotation."""
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


def seen(
    points: np.ndarray, viewmat: np.ndarray, K: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [S], pixels [S, 2] and depths [S] of the points [M, 3] in a camera's image of `size` (width, height)."""
    places = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    rows = np.flatnonzero(places[:, 2] > 0)
    pixels = places[rows] @ K.T
    with np.errstate(all="ignore"):  # depths may be too small to divide by
        pixels = pixels[:, :2] / pixels[:, 2:]
    within = ((pixels >= 0) & (pixels < size)).all(axis=1)
    return rows[within], pixels[within], places[rows[within], 2]


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] float64 world to camera of a camera at `center` [3] with `target` [3] in the middle of its image.
    `up` [3], which is not parallel to the view, points upwards there."""
    forward = target - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.block([[rotation, -rotation @ center[:, None]], [np.eye(1, 4, 3)]])


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """[C, 4] wxyz of rotations [C, 3, 3]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrices).as_quat(scalar_first=True)


def mean_neighbor_distances(points: Tensor, neighbors: int) -> Tensor:
    """[M]: mean distance of each point [M, 3], M >= 2, to its `neighbors` nearest other points (fewer, if the cloud has
    fewer). Points are finite, and may coincide."""
    from scipy.spatial import cKDTree

    tree, means = cKDTree(points.cpu().numpy()), np.empty(len(points))
    order = tree.indices  # leaf by leaf: what is near in space is looked for one after the other
    distances, _ = tree.query(tree.data[order], min(neighbors + 1, len(points)), workers=-1)
    means[order] = distances[:, 1:].mean(axis=1)  # the first is the point itself, or another one in its place
    return points.new_tensor(means)
