"""Distances to the nearest points."""

import numpy as np
import pytest
import torch

from turbogs_plugin.scene.nearest import mean_neighbor_distances

CLOUDS = {
    "uniform": lambda random: random.uniform(-1, 1, (1500, 3)),
    "heavy tails": lambda random: random.normal(size=(1500, 3)) ** 5,
    "a plane": lambda random: random.uniform(-1, 1, (1500, 3)) * [1, 1, 0],
    "clusters": lambda random: random.integers(0, 5, (1500, 1)) * 100 + random.normal(size=(1500, 3)) * 1e-2,
    "coincident": lambda random: np.repeat(random.normal(size=(300, 3)), 5, axis=0),
    "two": lambda random: random.normal(size=(2, 3)),
    "three": lambda random: random.normal(size=(3, 3)),
}


@pytest.mark.parametrize("cloud", CLOUDS)
def test_neighbor_distances_are_exact(cloud):
    points = CLOUDS[cloud](np.random.default_rng(0))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    neighbors = min(3, len(points) - 1)
    expected = np.sort(distances, axis=1)[:, :neighbors].mean(axis=1)
    np.testing.assert_allclose(mean_neighbor_distances(torch.from_numpy(points), 3), expected, rtol=1e-12, atol=1e-14)
