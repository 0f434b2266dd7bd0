"""Rows in the order of space."""

import math

import torch
from turbogs_plugin.strategies.density.row_order import BITS, spatial_order


def morton_key(point, extent: float) -> int:
    """Bit by bit."""
    key = 0
    for axis, x in enumerate(point):
        if not math.isfinite(x):
            cell = 2**BITS - 1
        else:
            cell = min(2**BITS - 1, max(0, int((x / (extent + abs(x)) + 1) * 2 ** (BITS - 1))))
        for bit in range(BITS):
            key |= (cell >> bit & 1) << (3 * bit + axis)
    return key


def test_order_is_that_of_the_keys():
    means = torch.randn(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    means[10:20] *= 1e6
    means[20] = math.nan
    means[30:40] = means[30]
    keys = [morton_key(point, 2.0) for point in means.tolist()]
    assert spatial_order(means, 2.0).tolist() == sorted(range(300), key=lambda row: (keys[row], row))


def test_neighbours_in_space_are_neighbours_in_memory():
    means = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))

    def step(points):
        return (points[1:] - points[:-1]).norm(dim=1).mean()

    assert step(means[spatial_order(means, 1.0)]) < 0.15 * step(means)


def test_far_and_none():
    assert spatial_order(torch.zeros(0, 3), 1.0).tolist() == []
    far = torch.tensor([[3e38, -3e38, 0.0], [-3e38, 3e38, 0.0], [math.inf, 0.0, 0.0]])
    assert sorted(spatial_order(far, 1.0).tolist()) == [0, 1, 2]
