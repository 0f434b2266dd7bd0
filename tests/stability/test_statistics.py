"""The statistics that choose Gaussians, in float32: how exact, and what they are on the renderer's worst inputs.

`tests/gpu/test_squares.py` asks the same of the kernels.
"""

from __future__ import annotations

import pytest
import torch
from helpers.raster_extremes import CASES, TWO_VIEWS, random_scene
from helpers.statistics_cases import STIFF, SURVIVED, pass_statistics, share_of_bound
from helpers.statistics_errors import CASES as MEASURED
from helpers.statistics_errors import measure_case, measure_window
from helpers.tolerances import STATISTICS, STIFF_STATISTICS


@pytest.mark.parametrize("case", MEASURED, ids=lambda case: case.name)
def test_statistics_are_close_to_float64(case):
    result = measure_case(case, torch.device("cpu"))
    bounds = STIFF_STATISTICS if case.name in STIFF else STATISTICS
    assert max(result.errors.values()) <= bounds.total, result
    assert result.median_square <= bounds.median_square and result.worst_square <= bounds.worst_square, result
    if case.name != STIFF[1]:  # where the squares are rounding
        assert result.exchanged <= bounds.exchanged, result


def test_the_sums_of_a_long_window_are_close_to_float64():
    result = measure_window(torch.device("cpu"), 3000)
    assert max(result.errors.values()) <= STATISTICS.total and result.worst_square <= STATISTICS.total
    assert result.exchanged == 0


@pytest.mark.parametrize("case", CASES)
def test_all_absolute_gradients_share_the_colours_gradient(case):
    """So that a threshold of the absolute gradient bounds how many Gaussians are above it."""
    assert share_of_bound(case, "cpu") <= 1


@pytest.mark.parametrize("assert_survived", SURVIVED)
def test_what_overflows_or_vanishes(assert_survived):
    assert_survived("cpu")


def test_a_gaussian_at_the_limit_of_alpha_has_no_square():
    """Alpha is cut at 0.999 in every pixel of both views, so no sample asks for more or less of it."""
    walls = random_scene(1, means=[0.0, 0.0, 0.0], scales=[5.0, 5.0, 5.0], opacities=50.0)
    stats, _ = pass_statistics(walls, TWO_VIEWS, "cpu")
    assert stats.weight_sums > 1000 and stats.square_sums == 0
    walls.opacities[:] = 5.0
    assert pass_statistics(walls, TWO_VIEWS, "cpu")[0].square_sums > 0
