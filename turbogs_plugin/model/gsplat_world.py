"""The coordinates that gsplat's example trainer works in (its `normalize_world_space`, which is on by default).

Facts of `examples/datasets/normalize.py` and `colmap.py` of gsplat 1.5.3 and main; all of it from the cameras and
points of a COLMAP reconstruction in its own coordinates:

1. The world is turned so that the mean of the cameras' up directions becomes (0, -1, 0), by the smallest rotation.
2. The origin becomes the median, axis by axis, of the places nearest to the old origin on the cameras' viewing axes.
   The unit becomes the median distance of the cameras from it.
3. The points' median becomes the origin, and their principal axes, longest first, become x, y and z.

The direction of a principal axis is an accident of the linear algebra library, and versions differ in which way up they
turn z. So there are four possible worlds, which differ by half turns. A model's own is the one in which the
reconstruction's points lie nearest to its Gaussians, in place and colour.
"""

from __future__ import annotations

import numpy as np

from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene.geometry import camera_centers

HALF_TURNS = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


def gsplat_worlds(viewmats: np.ndarray, points: np.ndarray) -> list[Similarity]:
    """The four changes from a capture's own coordinates into what may be gsplat's normalised world.

    Args:
        viewmats: [V, 4, 4] float64 world to camera, of all images.
        points: [M, 3] float64, of the reconstruction; M >= 4.

    Returns:
        Empty where the cameras or points do not determine a world.
    """
    from scipy.spatial.transform import Rotation

    if len(points) < 4:
        return []
    centers, axes = camera_centers(viewmats), viewmats[:, :3, :3]  # rows of a rotation: right, down, forward
    up = -axes[:, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-9:
        return []
    upright = Rotation.align_vectors([[0.0, -1.0, 0.0]], [up])[0].as_matrix()  # by the smallest angle
    centers, forward = centers @ upright.T, axes[:, 2] @ upright.T
    nearest = centers - (centers * forward).sum(axis=1, keepdims=True) * forward
    focus = np.median(nearest, axis=0)
    distance = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    if not distance > 0:
        return []
    first = Similarity(upright, 1.0 / distance, -focus / distance)
    turned = (points @ upright.T - focus) / distance
    _, vectors = np.linalg.eigh(np.cov(turned, rowvar=False))
    rotation = vectors[:, ::-1].T
    if np.linalg.det(rotation) < 0:
        rotation = rotation * np.array([[-1.0], [1.0], [1.0]])
    second = Similarity(rotation, 1.0, -rotation @ np.median(turned, axis=0))
    world = second.after(first)
    return [Similarity(np.diag(signs), 1.0, np.zeros(3)).after(world) for signs in HALF_TURNS]
