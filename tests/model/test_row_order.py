"""Rows in the order of space."""

import math

import pytest
import torch
from helpers.optimizers import make_gaussians

from turbogs_plugin.model.row_order import BITS, in_order_of_space, spatial_order
from turbogs_plugin.types import RowUpdate, Step


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


def test_far_and_none():
    assert spatial_order(torch.zeros(0, 3), 1.0).tolist() == []
    far = torch.tensor([[3e38, -3e38, 0.0], [-3e38, 3e38, 0.0], [math.inf, 0.0, 0.0]])
    assert sorted(spatial_order(far, 1.0).tolist()) == [0, 1, 2]


@pytest.mark.parametrize("moved", [False, True])
def test_an_update_has_its_new_rows_in_the_order_of_space(moved):
    """Nothing else of it changes: each new row keeps its source, its freshness and its values."""
    gaussians = make_gaussians(20)
    source = torch.tensor([*range(20), *range(0, 20, 2)])
    fresh = torch.arange(30) >= 20
    values = {"means": gaussians.means[source] + 0.3 * fresh[:, None]} if moved else {}
    values["opacities"] = torch.arange(30.0)
    update = RowUpdate(source, fresh, values, reset=("opacities",), num_cloned=10)
    ordered = in_order_of_space(update, gaussians, Step(5, 10, 5, scene_extent=1.5))
    rows = ordered.values["opacities"].long()
    assert sorted(rows.tolist()) == list(range(30)) and not torch.equal(rows, torch.arange(30))
    before, after = update.apply(gaussians), ordered.apply(gaussians)
    assert spatial_order(after.means, 1.5).tolist() == list(range(30))
    assert all(torch.equal(value[rows], getattr(after, name)) for name, value in before.items())
    assert torch.equal(ordered.fresh, fresh[rows]) and ordered.reset == ("opacities",) and ordered.num_cloned == 10
    assert in_order_of_space(update, gaussians, Step(6, 10, 5)) is update  # after densification, rows are only removed
