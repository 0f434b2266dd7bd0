"""Moment-damped LM (paper section 3.9): against numpy, in its limits, and at its worst inputs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.optimizers import STEP, all_finite, clone, equal, make_gaussians, make_gradients, ready, scaled
from hypothesis import given, settings
from hypothesis import strategies as st

from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam

NAMES = ("means", "scales", "quats", "sh0", "opacities")
WIDTHS = (3, 3, 4, 3, 1)


def packed(tensors: dict) -> np.ndarray:
    """[..., 14] out of the five parameters' arrays, in the order of the blocks."""
    return np.concatenate([tensors[name].numpy().reshape(*tensors["opacities"].shape, -1) for name in NAMES], axis=-1)


def expected_delta(rows, losses, mean, square, steps, optimizer) -> np.ndarray:
    """[14] one Gaussian's change by the equation, with dense solves in float64."""
    rates = optimizer.learning_rates.at(STEP)
    eta = np.repeat([getattr(rates, name) for name in NAMES], WIDTHS)
    delta = np.zeros(14)
    if optimizer.units == "balanced":
        mean, square = mean / (1 - optimizer.beta1**steps), square / (1 - optimizer.beta2**steps)
        damping = (np.sqrt(square) + optimizer.eps) / eta
        weights = optimizer.curvature / losses
    else:
        damping, weights = np.sqrt(square) + optimizer.eps, np.ones_like(losses)
    for block in (slice(0, 10), slice(10, 14)):
        matrix = np.diag(damping[block]) + np.einsum("k,ki,kj->ij", weights, rows[:, block], rows[:, block])
        delta[block] = np.linalg.solve(matrix, -mean[block])
    if optimizer.units == "balanced" and optimizer.max_step > 0:
        bound = np.maximum(optimizer.max_step * eta, np.abs(mean / damping))
        delta = np.clip(delta, -bound, bound)
    return delta


@pytest.mark.parametrize("views", [1, 3, 12])
@pytest.mark.parametrize(
    "config",
    [
        *({}, {"max_step": 0.0}, {"max_step": 0.3, "curvature": 1.0}, {"rows": "summed", "max_step": 0.0}),
        *({"units": "paper"}, {"units": "paper", "rows": "summed"}),
    ],
)
def test_equals_numpy(views, config):
    count = 5
    gaussians = make_gaussians(count)
    optimizer = ready(MomentLMOptimizer(**config), gaussians)
    size = 1e-2 if optimizer.units == "paper" else 1e-5  # in the paper's units the coupling fades as gradients do
    mean, square = np.zeros((count, 14)), np.zeros((count, 14))
    for iteration in range(4):
        gradients = make_gradients(views, count, seed=iteration, size=size)
        rows, losses = packed({name: getattr(gradients, name) for name in NAMES}), gradients.view_losses.numpy()
        gradient = rows.sum(axis=0)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        if optimizer.rows == "summed":
            rows, losses = rows.sum(axis=0, keepdims=True), losses.sum(axis=0, keepdims=True)
        before = packed(dict(clone(gaussians).items()))
        optimizer.step(gaussians, gradients, STEP)
        change = packed(dict(gaussians.items())) - before
        for i in range(count):
            moments = mean[i], square[i], iteration + 1, optimizer
            expected = expected_delta(rows[:, i], losses[:, i], *moments)
            np.testing.assert_allclose(change[i], expected, rtol=1e-6, atol=1e-13)
            adam = expected_delta(0 * rows[:, i], losses[:, i], *moments)
            assert np.abs(change[i] / adam - 1).max() > 0.1  # or the rows had no say here


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("without", ["no shares", "no curvature", "no gradient"])
def test_without_rows_it_is_adam_to_the_last_bit(dtype, without):
    lm_gaussians, adam_gaussians = make_gaussians(9, dtype=dtype), make_gaussians(9, dtype=dtype)
    curvature = 0.0 if without == "no curvature" else 0.5
    lm = ready(MomentLMOptimizer(eps=1e-15, curvature=curvature), lm_gaussians)
    adam = ready(SparseAdam(eps=1e-15), adam_gaussians)
    for seed in range(8):
        gradients = make_gradients(3, 9, seed, dtype)
        if without == "no shares" or seed == 0:
            gradients.view_losses.zero_()
        if without == "no gradient" and seed > 0:
            gradients = scaled(gradients, 0.0)
            gradients.view_losses.fill_(0.1)
        lm.step(lm_gaussians, gradients, STEP)
        adam.step(adam_gaussians, gradients, STEP)
    assert equal(lm_gaussians, adam_gaussians)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-8)])
def test_scale_of_the_loss_does_not_matter(factor, dtype, tolerance):
    """Twenty steps of gradients about 1e-5 (1e-11 to 10 when scaled), relative to the way that was gone. What is left
    is eps = 1e-20 against 1e-11."""
    paths = []
    for scale in (1.0, factor):
        gaussians = make_gaussians(20, dtype=dtype)
        start, optimizer = clone(gaussians), ready(MomentLMOptimizer(), gaussians)
        for seed in range(20):
            optimizer.step(gaussians, scaled(make_gradients(3, 20, seed, dtype), scale), STEP)
        paths.append({name: value - getattr(start, name) for name, value in gaussians.items()})
    for name in NAMES:
        first, second = (path[name] for path in paths)
        assert (first - second).norm() <= tolerance * first.norm(), name


@given(
    st.lists(st.floats(-30, 30), min_size=14, max_size=14),
    st.integers(1, 4),
    st.sampled_from([torch.float32, torch.float64]),
    st.floats(-40, 30),
    st.integers(0, 5),
)
@settings(max_examples=50, deadline=None)
def test_any_mixture_of_magnitudes_within_a_block(exponents, views, dtype, loss_exponent, seed):
    """1e-30 to 1e30 side by side, rows parallel or not, any share of the loss: finite, no longer than the bound."""
    gaussians = make_gaussians(3, dtype=dtype)
    start, optimizer = clone(gaussians), ready(MomentLMOptimizer(), gaussians)
    gradients = make_gradients(views, 3, seed, dtype, size=1.0)
    sizes = torch.tensor([10.0**e for e in exponents], dtype=dtype)
    for name, columns in zip(NAMES, sizes.split(WIDTHS), strict=True):
        value = getattr(gradients, name)
        if seed == 0:
            value[:] = value[:1]  # parallel rows
        value.mul_(columns if name != "opacities" else columns[0])
    gradients.view_losses.fill_(10.0**loss_exponent)
    for _ in range(3):
        before = clone(gaussians)
        optimizer.step(gaussians, gradients, STEP)
        assert all_finite(gaussians)
        for name in NAMES:
            rate = getattr(optimizer.learning_rates.at(STEP), name)
            change = (getattr(gaussians, name) - getattr(before, name)).abs()
            # Adam's own bound for equal gradients is the rate; parameters of size 10 round to 1e-6 in float32.
            assert change.max() <= rate * (1 + 1e-4) + 2e-6, name
    assert not equal(start, gaussians) and int(optimizer.skipped) == 0


def test_zero_rates_hold_parameters():
    rates = LearningRates(means=0, means_final=0, quats=0)
    gaussians = make_gaussians(5, dtype=torch.float32)
    before, optimizer = clone(gaussians), ready(MomentLMOptimizer(rates), gaussians)
    optimizer.step(gaussians, make_gradients(3, 5, dtype=torch.float32), STEP)
    assert torch.equal(gaussians.means, before.means) and torch.equal(gaussians.quats, before.quats)
    assert not torch.equal(gaussians.scales, before.scales) and all_finite(gaussians)


@pytest.mark.parametrize("share", [math.nan, math.inf, -1.0, 0.0, 1e-45, 1e38])
def test_a_useless_share_of_the_loss(share):
    """A share that says nothing drops its row; one that is tiny only stops the motion along it."""
    gaussians = make_gaussians(2, dtype=torch.float32)
    optimizer = ready(MomentLMOptimizer(), gaussians)
    gradients = make_gradients(3, 2, dtype=torch.float32)
    gradients.view_losses[1, 0] = share
    gradients.opacities[1], gradients.sh0[1] = 0.0, 0.0  # this view: no row for the second block
    optimizer.step(gaussians, gradients, STEP)
    assert all_finite(gaussians) and int(optimizer.skipped) == 0
