"""Density control by squares on a GPU: the kernels' sums, draws equal to those of a CPU, and the NCC term at weight 1
on stiff tiles."""

from __future__ import annotations

import pytest
import torch
from helpers.raster_cases import GPU_ONLY
from helpers.raster_extremes import CASES
from helpers.squares import SQUARES, event_at, small_model, spread_squares, window
from helpers.statistics_cases import STIFF, SURVIVED, share_of_bound
from helpers.statistics_errors import CASES as MEASURED
from helpers.statistics_errors import measure_case, measure_window
from helpers.stiff_tiles import TILES, gradients
from helpers.tolerances import GPU_STATISTICS, GPU_STIFF_STATISTICS, STRUCTURE_BOUND

from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.losses import CharbonnierNccLoss

pytestmark = GPU_ONLY

ON_THE_THRESHOLD = "faint: opacity 1 / 250"


@pytest.mark.parametrize("case", MEASURED, ids=lambda case: case.name)
def test_statistics_are_close_to_float64(case):
    result = measure_case(case, torch.device("cuda"))
    bounds = GPU_STIFF_STATISTICS if case.name in (*STIFF, ON_THE_THRESHOLD) else GPU_STATISTICS
    assert result.errors["weight_sums"] <= bounds.total and result.errors["absgrad_sums"] <= bounds.total, result
    if case.name != STIFF[1]:  # the kernels' sums flush what is below float32's normal range
        assert result.errors["square_sums"] <= bounds.total, result
        assert result.median_square <= bounds.median_square and result.exchanged <= bounds.exchanged, result


def test_the_sums_of_a_long_window_are_close_to_float64():
    assert max(measure_window(torch.device("cuda")).errors.values()) <= 1e-5


@pytest.mark.parametrize("case", CASES)
def test_all_absolute_gradients_share_the_colours_gradient(case):
    assert share_of_bound(case, "cuda") <= 1


@pytest.mark.parametrize("assert_survived", SURVIVED)
def test_what_overflows_or_vanishes(assert_survived):
    assert_survived("cuda")


@pytest.mark.parametrize("count", [1, 2, 3, 40, 1000])
@pytest.mark.parametrize("value", [None, 0.0, 1e-14, float("inf"), float("nan")])
def test_the_same_rows_are_drawn_as_on_a_cpu(count, value):
    """Keys of the draw differ by a last bit of the logarithm; distinct sums and equal ones both give the same rows."""
    squares = spread_squares(count) if value is None else [value] * count
    changes = []
    for device in ("cpu", "cuda"):
        gaussians = small_model(count).map(lambda tensor, device=device: tensor.to(device))
        density = ErrorDrivenDensity(**SQUARES, max_gaussians=count + 3)
        density.setup(gaussians)
        for name, sums in vars(window(squares)).items():
            getattr(density.stats, name).copy_(sums)
        changes.append(density.update(gaussians, event_at(1200)))
    assert torch.equal(changes[0].source, changes[1].source.cpu())
    assert changes[0].num_pruned == changes[1].num_pruned


def test_the_loss_is_close_to_float64_on_stiff_tiles():
    """So it is bounded there as the reference's is (tests/stability/test_structure_term.py)."""
    terms = CharbonnierNccLoss().terms
    exact = gradients(terms, "cpu", torch.float64)
    for name, got, wanted in zip(TILES, gradients(terms, "cuda"), exact, strict=True):
        assert (got - wanted).norm() <= STRUCTURE_BOUND * wanted.norm().clamp(min=1e-9), name
