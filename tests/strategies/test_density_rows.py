"""What density controllers share: which Gaussians are finite, and that one always stays."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.optimizers import clone, make_gaussians

from turbogs_plugin.strategies.density.rows import finite_rows, keep_one
from turbogs_plugin.types import PARAMETER_NAMES


@pytest.mark.parametrize("bands", [0, 3])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_one_number_that_is_not_finite_spoils_its_row(name, value, bands):
    gaussians = make_gaussians(5, bands=bands)
    numbers = getattr(gaussians, name)
    spoiled = numbers.numel() > 0
    if spoiled:
        numbers[3].view(-1)[-1] = value
    before = clone(gaussians)
    assert finite_rows(gaussians).tolist() == [True, True, True, not spoiled, True]
    for key, tensor in gaussians.items():  # only looked at
        torch.testing.assert_close(tensor, getattr(before, key), rtol=0, atol=0, equal_nan=True)


def test_finite_rows_have_finite_variances():
    """exp(2 * 44) is finite in float32, and exp(2 * 45) is not."""
    gaussians = make_gaussians(4, dtype=torch.float32)
    gaussians.means[0], gaussians.opacities[1] = 3e38, -3e38
    gaussians.scales[2, 1], gaussians.scales[3, 1] = 44.0, 45.0
    assert finite_rows(gaussians).tolist() == [True, True, True, False]
    assert finite_rows(make_gaussians(0)).tolist() == []


def test_one_stays():
    """The most opaque finite Gaussian stays, only where none would."""
    gaussians = make_gaussians(4)
    gaussians.opacities[:] = torch.tensor([1.0, 3.0, 2.0, 9.0])
    gaussians.means[3] = math.nan
    some, none = torch.tensor([True, False, True, False]), torch.zeros(4, dtype=torch.bool)
    assert keep_one(some, gaussians) == (some, 2)
    kept, count = keep_one(none, gaussians)
    assert kept.tolist() == [False, True, False, False] and count == 1 and not none.any()
