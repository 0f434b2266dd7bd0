"""The coordinates that a model's file is in: which change brings it to where its capture's points are.

nerfstudio centres, turns and scales the poses that it trains on, and writes the change (``dataparser_transforms.json``)
into the folder of the training: ``new = scale * (transform @ old)``. Its old coordinates are COLMAP's, or those of a
``transforms.json`` by `ns-process-data`, which turns COLMAP's axes once more.

gsplat's example trainer works in a world of its own (`normalize_world_space`, its default), by the cameras and points
of a COLMAP reconstruction (`examples/datasets/normalize.py` and `colmap.py` of gsplat 1.5.3 and main):

1. The world is turned so that the mean of the cameras' up directions becomes (0, -1, 0), by the smallest rotation.
2. The origin becomes the median, axis by axis, of the places nearest to the old origin on the cameras' viewing axes.
   The unit becomes the median distance of the cameras from it.
3. The points' median becomes the origin, and their principal axes, longest first, become x, y and z.

The direction of a principal axis is an accident of the linear algebra library, and versions differ in which way up they
turn z. So there are four possible worlds, which differ by half turns.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from turbogs_plugin.captures.capture import text_of
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene.geometry import camera_centers
from turbogs_plugin.types import SH_C0, Gaussians
from turbogs_plugin.yaml_json import parse_json

TRANSFORMS = "dataparser_transforms.json"
TURNS = (np.eye(3), np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]), np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]))
"""COLMAP's axes to those of `ns-process-data`: not at all, as it does since 1.0, and as it did before."""
HALF_TURNS = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
POINTS_AT_MOST, GAUSSIANS_AT_MOST, FEWEST_POINTS = 20_000, 200_000, 1000
"""Numbers that are looked at; points below which nothing tells that a model does not fit: they lie too far apart."""
FARTHEST_POINTS, FARTHEST_GAUSSIANS = 0.2, 0.13
"""Median distances, in place and colour, of points from the nearest Gaussian and of Gaussians from the nearest point,
over the points' median distance from their middle, both of which a model exceeds that does not fit. Of five captures,
models of half the points, with colours off by 0.085, have 0.06 to 0.09 and 0.10 to 0.12 beside the other half; turned
or scaled about their middle, 0.2 to 0.9 and 0.14 to 1.9. Of a model that was cut out of its scene, points lie far."""


def nearest_change(
    gaussians: Gaussians, changes: list[Similarity], points: np.ndarray, colors: np.ndarray
) -> tuple[Similarity, bool]:
    """The change, of those from a model's coordinates to its capture's own, by which points ([M, 3] float64, M >= 1,
    and [M, 3] uint8) and Gaussians (float64, perhaps not finite) lie nearest to one another, in place and colour; and
    whether the model fits the points then."""
    from scipy.spatial import cKDTree

    every = slice(None, None, -(-len(points) // POINTS_AT_MOST))
    middle = np.median(points[every], axis=0)
    size = float(np.median(np.linalg.norm(points[every] - middle, axis=1))) or 1.0
    wanted = np.concatenate([(points[every] - middle) / size, colors[every] / 255.0], axis=1)  # [P, 6]
    rows = np.concatenate([gaussians.means.numpy(), SH_C0 * gaussians.sh0[:, 0].numpy() + 0.5], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows, tree = rows[:: -(-len(rows) // GAUSSIANS_AT_MOST) or 1], cKDTree(wanted)
    apart = []
    for change in changes if len(rows) else ():
        places = (change.scale * rows[:, :3] @ change.rotation.T + change.translation - middle) / size
        found = np.concatenate([places, rows[:, 3:]], axis=1)
        some = found[:: -(-len(found) // POINTS_AT_MOST)]
        apart.append([float(np.median(a.query(b)[0])) for a, b in ((cKDTree(found), wanted), (tree, some))])
    if not apart:
        return changes[0], True
    best = int(np.argmin(np.sum(apart, axis=1)))
    far = np.array(apart[best]) > (FARTHEST_POINTS, FARTHEST_GAUSSIANS)
    return changes[best], len(points) < FEWEST_POINTS or not far.all()


def out_of_nerfstudio(file: Path) -> list[Similarity]:
    """The changes from nerfstudio's world to what may be a capture's own coordinates; none where no `TRANSFORMS` lies
    beside a file. Raises `InputError` where that is no change."""
    source = file.parent / TRANSFORMS
    if not source.is_file():
        return []
    content = parse_json(text_of(source), str(source))
    try:
        matrix, scale = np.array(content["transform"], dtype=np.float64), float(content["scale"])
        rotation = matrix[:, :3]
        if matrix.shape != (3, 4) or not scale > 0 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise ValueError
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError(f"{source} has no transform of 3x4 numbers and scale: copy it from nerfstudio again") from None
    back = Similarity(rotation, scale, scale * matrix[:, 3]).inverse()
    return [Similarity(turn, 1.0, np.zeros(3)).after(back) for turn in TURNS]


def gsplat_worlds(viewmats: np.ndarray, points: np.ndarray) -> list[Similarity]:
    """The four changes from a capture's own coordinates into what may be gsplat's normalised world, by the world to
    camera matrices [V, 4, 4] of all images and the points [M, 3], float64; none where these do not determine it."""
    from scipy.spatial.transform import Rotation

    centers, axes = camera_centers(viewmats), viewmats[:, :3, :3]  # rows of a rotation: right, down, forward
    up = -axes[:, 1].mean(axis=0)
    if len(points) < 4 or np.linalg.norm(up) < 1e-9:
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
