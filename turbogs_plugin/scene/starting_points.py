"""Random points to start from, for captures that bring none."""

from __future__ import annotations

import numpy as np

from turbogs_plugin.scene.poses import camera_centers

NUM_RANDOM_POINTS = 50_000
RANDOM_POINTS_SIDE = 1.0
"""Side of the cube of random points, in distances of the cameras from what they look at."""


def random_points(viewmats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([M, 3] float64 points, [M, 3] uint8 colours), the same for the same cameras.

    The cube's centre is the point nearest to all viewing axes, its side the median distance of the cameras from it.

    Args:
        viewmats: [V, 4, 4] float64 world to camera.
    """
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    # A slight pull towards the cameras' mean settles the case of parallel axes.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [V, 3, 3]
    mean = centers.mean(axis=0)
    pull = 1e-3 * len(centers) * np.eye(3)
    offsets = np.einsum("vij,vj->i", across, centers - mean)
    focus = mean + np.linalg.solve(across.sum(axis=0) + pull, offsets)
    side = RANDOM_POINTS_SIDE * float(np.median(np.linalg.norm(centers - focus, axis=1)))
    random = np.random.default_rng(0)
    points = focus + random.uniform(-0.5, 0.5, (NUM_RANDOM_POINTS, 3)) * (side or 1.0)
    return points, random.integers(0, 256, (NUM_RANDOM_POINTS, 3), dtype=np.uint8)


def about_cameras(count: int) -> str:
    """What `random_points` gives, for a note: so many of them."""
    return f"{count:,} random ones about what the cameras look at"
