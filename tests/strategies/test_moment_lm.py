"""Moment-damped LM (paper section 3.9): against numpy, in its limits, and at its worst inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optimizers import STEP, all_finite, clone, equal, make_gaussians, make_gradients, ready
from hypothesis import given, settings
from hypothesis import strategies as st

from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer

NAMES = ("means", "scales", "quats", "sh0", "opacities")
WIDTHS = (3, 3, 4, 3, 1)


def packed(tensors: dict) -> np.ndarray:
    """[..., 14] out of the five parameters' arrays, in the order of the blocks."""
    return np.concatenate([tensors[name].numpy().reshape(*tensors["opacities"].shape, -1) for name in NAMES], axis=-1)


def expected_delta(rows, mean, square, optimizer) -> np.ndarray:
    """[14] one Gaussian's change by the equation, with dense solves in float64."""
    rates = optimizer.learning_rates.at(STEP)
    delta = np.zeros(14)
    damping = np.sqrt(square) + optimizer.eps
    for block in (slice(0, 10), slice(10, 14)):
        matrix = np.diag(damping[block]) + sum(np.outer(row[block], row[block]) for row in rows)
        delta[block] = np.linalg.solve(matrix, -mean[block])
    return delta * np.repeat([getattr(rates, name) for name in NAMES], WIDTHS) if optimizer.scaled else delta


@pytest.mark.parametrize("views", [1, 3, 12])
@pytest.mark.parametrize("scaled", [True, False])
def test_equals_numpy(views, scaled):
    count = 5
    gaussians = make_gaussians(count)
    optimizer = ready(MomentLMOptimizer(scaled=scaled), gaussians)
    mean, square = np.zeros((count, 14)), np.zeros((count, 14))
    for iteration in range(4):
        gradients = make_gradients(views, count, seed=iteration, size=1e-2)  # the coupling fades as gradients do
        rows = packed({name: getattr(gradients, name) for name in NAMES})
        gradient = rows.sum(axis=0)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        before = packed(dict(clone(gaussians).items()))
        optimizer.step(gaussians, gradients, STEP)
        change = packed(dict(gaussians.items())) - before
        for i in range(count):
            moments = mean[i], square[i], optimizer
            np.testing.assert_allclose(change[i], expected_delta(rows[:, i], *moments), rtol=1e-6, atol=1e-13)
            uncoupled = expected_delta(0 * rows[:, i], *moments)
            assert np.abs(change[i] / uncoupled - 1).max() > 0.1  # or the rows had no say here


@given(
    st.lists(st.floats(-30, 30), min_size=14, max_size=14),
    st.integers(1, 4),
    st.sampled_from([torch.float32, torch.float64]),
    st.integers(0, 5),
)
@settings(max_examples=50, deadline=None)
def test_any_mixture_of_magnitudes_within_a_block(exponents, views, dtype, seed):
    """1e-30 to 1e30 side by side, rows parallel or not: finite, and no Gaussian left out."""
    gaussians = make_gaussians(3, dtype=dtype)
    start, optimizer = clone(gaussians), ready(MomentLMOptimizer(), gaussians)
    gradients = make_gradients(views, 3, seed, dtype, size=1.0)
    sizes = torch.tensor([10.0**e for e in exponents], dtype=dtype)
    for name, columns in zip(NAMES, sizes.split(WIDTHS), strict=True):
        value = getattr(gradients, name)
        if seed == 0:
            value[:] = value[:1]  # parallel rows
        value.mul_(columns if name != "opacities" else columns[0])
    for _ in range(3):
        optimizer.step(gaussians, gradients, STEP)
        assert all_finite(gaussians)
    assert not equal(start, gaussians)
    assert int(optimizer.skipped) == 0


def test_zero_rates_hold_parameters():
    rates = LearningRates(means=0, means_final=0, quats=0)
    gaussians = make_gaussians(5, dtype=torch.float32)
    before, optimizer = clone(gaussians), ready(MomentLMOptimizer(rates), gaussians)
    optimizer.step(gaussians, make_gradients(3, 5, dtype=torch.float32), STEP)
    assert torch.equal(gaussians.means, before.means) and torch.equal(gaussians.quats, before.quats)
    assert not torch.equal(gaussians.scales, before.scales) and all_finite(gaussians)
