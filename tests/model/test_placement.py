"""Whether a model fits a capture's points, and by which change; gsplat's world against what its own code gives."""

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians
from scipy.spatial.transform import Rotation

from turbogs_plugin.model.placement import HALF_TURNS, gsplat_worlds, nearest_change
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.types import SH_C0

SAME = Similarity(np.eye(3), 1.0, np.zeros(3))


@pytest.mark.parametrize(
    ("turn", "scale", "cut", "count", "fits"),
    [
        (0.0, 1.0, False, 2000, True),
        (0.0, 1.0, True, 2000, True),  # only the Gaussians of an object
        (0.7, 0.3, False, 2000, False),
        (0.0, 0.3, False, 2000, False),
        (0.7, 0.3, False, 500, True),  # too few points tell nothing
    ],
)
def test_a_model_fits_where_it_lies_by_the_points(turn, scale, cut, count, fits):
    """Points of a surface whose colour goes with the place."""
    u, v = np.random.default_rng(0).uniform(-1, 1, size=(2, count))
    points = np.stack([u, v, 0.3 * np.sin(3 * u)], axis=1) + 5.0
    shades = np.stack([0.5 + 0.4 * u, 0.5 + 0.4 * v, 0.5 + 0 * u], axis=1)
    kept = np.hypot(u, v) < (0.3 if cut else 9)
    model = random_gaussians(int(kept.sum()), 0, dtype=torch.float64)
    change = Similarity(Rotation.from_euler("xyz", (turn, turn, 0)).as_matrix(), scale, np.full(3, 5 * (1 - scale)))
    model.means = torch.from_numpy(points[kept] + 0.01)
    model.sh0 = torch.from_numpy((shades[kept] - 0.5) / SH_C0)[:, None]
    moved = change.apply(model)
    given = points, (255 * shades).astype(np.uint8)
    assert nearest_change(moved, [SAME], *given) == (SAME, fits)
    assert nearest_change(moved, [SAME, change.inverse()], *given)[1]
    assert nearest_change(moved.map(lambda value: value * torch.nan), [SAME], *given)[1]


# examples/datasets/normalize.py of gsplat at 90d7b4b3, on the cameras and points below.
THEIRS = np.array(
    [
        [0.2709479, 0.0003353, 0.0895193, -0.9150489],
        [0.0895198, -0.0004327, -0.2709476, -0.8796980],
        [-0.0001826, 0.2853529, -0.0005160, -0.1471171],
    ]
)


def cameras_and_points() -> tuple[np.ndarray, np.ndarray]:
    n, k = np.arange(12), np.arange(200)
    centers = np.stack([4 + 3 * np.cos(n * 0.5), 1 + 0.2 * np.sin(1.7 * n), -2 + 3 * np.sin(n * 0.5)], axis=1)
    target, up = np.array([4.2, 0.3, -1.8]), np.array([0.1, -1.0, 0.3])
    viewmats = [look_at(center, target + 0.3 * np.sin(i + np.arange(3)), up) for i, center in enumerate(centers)]
    x, y = 4 + 2.5 * np.sin(1.3 * k), 0.5 + 0.4 * np.sin(2.1 * k + 0.3) + 0.1 * np.cos(k) ** 3
    return np.stack(viewmats), np.stack([x, y, -2 + 1.6 * np.cos(0.7 * k) + 0.5 * np.sin(1.3 * k)], axis=1)


def test_one_of_the_four_worlds_is_what_gsplat_makes():
    worlds = gsplat_worlds(*cameras_and_points())
    matrices = [np.c_[world.scale * world.rotation, world.translation] for world in worlds]
    distances = sorted(np.abs(matrix - THEIRS).max() for matrix in matrices)
    assert len(worlds) == 4 and distances[0] < 1e-6 and distances[1] > 0.1
    for matrix, signs in zip(matrices, HALF_TURNS, strict=True):
        np.testing.assert_allclose(matrix, np.array(signs)[:, None] * matrices[0])
    assert all(np.isclose(np.linalg.det(world.rotation), 1.0) for world in worlds)


def test_no_world_where_nothing_determines_one():
    viewmats, points = cameras_and_points()
    assert gsplat_worlds(viewmats, points[:3]) == []
    upside_down = viewmats[:1] * np.array([-1.0, -1.0, 1.0, 1.0])[:, None]  # the two cameras' ups cancel
    assert gsplat_worlds(np.concatenate([viewmats[:1], upside_down]), points) == []
