"""Learning rates, sparse Adam (beside torch's in test_dense_adam.py), and the state that all optimizers share."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from helpers.optimizers import STEP, all_finite, clone, equal, make_gaussians, make_gradients, ready
from helpers.refusals import assert_refused

from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.dense_adam import DenseAdam
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES, RowUpdate, Step

OPTIMIZERS = [SparseAdam, MomentLMOptimizer]
ANY_OPTIMIZER = [*OPTIMIZERS, partial(DenseAdam, opacity_reg=0.01, scale_reg=0.01)]


def test_rates_at_start_middle_and_end():
    rates = LearningRates(means=1e-2, means_final=1e-4, final_factor=0.04, batch_scale=3.0)
    for iteration, means, factor in ((0, 1e-2, 1.0), (500, 1e-3, 0.2), (1000, 1e-4, 0.04), (2000, 1e-4, 0.04)):
        at = rates.at(Step(iteration, 1000, 700, scene_extent=5.0))
        assert at.means == pytest.approx(3 * 5 * means)
        for name in PARAMETER_NAMES[1:]:
            assert getattr(at, name) == pytest.approx(3 * factor * getattr(rates, name))
    assert LearningRates(means=0, means_final=0).at(STEP).means == 0


@pytest.mark.parametrize(("total", "gain"), [(5000, 1.0), (20_000, 0.5), (1, 1.75)])
def test_first_rates_fall_with_the_length_of_a_run_and_last_ones_and_the_means_do_not(total, gain):
    plain, rates = (LearningRates(final_factor=0.25, written_for=written_for) for written_for in (0, 5000))
    for fraction, factor in ((0.0, gain), (0.5, gain**0.5), (1.0, 1.0)):
        step = Step(round(fraction * total), total, total)
        factor = factor if total > 1 or fraction != 0.5 else gain
        assert rates.at(step).sh0 == pytest.approx(factor * plain.at(step).sh0)
        assert rates.at(step).means == plain.at(step).means


def test_first_step_is_the_rate_in_float32():
    """The bias correction cancels: 1 - 0.999 computed as a difference would be off by 5e-5."""
    gaussians = make_gaussians(50, dtype=torch.float32)
    gaussians.opacities.zero_()
    optimizer = ready(SparseAdam(), gaussians)
    optimizer.step(gaussians, make_gradients(2, 50, dtype=torch.float32), STEP)
    rate = optimizer.learning_rates.at(STEP).opacities
    torch.testing.assert_close(gaussians.opacities.abs(), torch.full((50,), rate), rtol=1e-6, atol=0)


@pytest.mark.parametrize("cls", OPTIMIZERS)
def test_untouched_rows_stand_still_and_count_their_own_steps(cls):
    """A Gaussian touched in iterations 0 and 2 ends where one does that knows of these two only."""
    sparse, dense = make_gaussians(4), make_gaussians(4)
    sparse_optimizer, dense_optimizer = ready(cls(), sparse), ready(cls(), dense)
    for iteration in range(3):
        gradients = make_gradients(2, 4, seed=iteration)
        if iteration != 1:
            dense_optimizer.step(dense, gradients, STEP)
        gradients.touched[1] = iteration != 1
        before = clone(sparse)
        sparse_optimizer.step(sparse, gradients, STEP)
        if iteration == 1:
            assert all(torch.equal(value[1], getattr(before, name)[1]) for name, value in sparse.items())
            assert not torch.equal(sparse.means[0], before.means[0])
    for name, value in sparse.items():
        assert torch.equal(value[1], getattr(dense, name)[1])
    assert sparse_optimizer.moments.steps.tolist() == [3, 2, 3, 3]


@pytest.mark.parametrize("cls", OPTIMIZERS)
@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_gradient_skips_one_gaussian(cls, name, bad):
    """Beside it one whose update was not due, as nothing touched it: that one is not counted."""
    clean, dirty, gradients = make_gaussians(5), make_gaussians(5), make_gradients(3, 5)
    gradients.touched[1] = False
    optimizers, start = [ready(cls(), clean), ready(cls(), dirty)], clone(dirty)
    optimizers[0].step(clean, gradients, STEP)
    value = getattr(gradients, name)
    (value[1:3] if name == "shN" else value[1, 1:3]).fill_(bad)
    optimizers[1].step(dirty, gradients, STEP)
    for parameter in PARAMETER_NAMES:
        result, expected = getattr(dirty, parameter), getattr(clean, parameter).clone()
        expected[2] = getattr(start, parameter)[2]
        assert torch.equal(result, expected), parameter
    assert [int(optimizer.skipped) for optimizer in optimizers] == [0, 1]
    assert optimizers[1].moments.steps.tolist() == [1, 0, 0, 1, 1]


@pytest.mark.parametrize(("cls", "views"), [*((cls, 10) for cls in ANY_OPTIMIZER), (SparseAdam, 250)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_survives_any_finite_gradient_and_scale(cls, dtype, views):
    """Up to the largest float, in runs long enough for the moments to fill; the state stays finite too. More views than
    a kernel takes do not cancel."""
    sizes = torch.tensor([0.0, 1e-38, 1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e20, 1e30, 3e38], dtype=dtype)
    gaussians = make_gaussians(len(sizes), dtype=dtype)
    gaussians.scales[4:] = torch.tensor([-200.0, -20.0, 0.0, 20.0, 88.0, 200.0], dtype=dtype)[:, None]
    optimizer = ready(cls(), gaussians)
    for seed in range(30 if views == 10 else 1):
        gradients = make_gradients(views, len(sizes), seed, dtype, size=1.0)
        for name in PARAMETER_NAMES:
            value = getattr(gradients, name)
            rows = sizes.reshape(-1, *[1] * (value.dim() - (1 if name == "shN" else 2)))
            (value.sign_() if views == 10 else value.fill_(1.0)).mul_(rows)
        optimizer.step(gaussians, gradients, STEP)
    assert all_finite(gaussians)
    assert all(bool(torch.isfinite(v).all()) for v in optimizer.state_dict().values())


@pytest.mark.parametrize("cls", ANY_OPTIMIZER)
@pytest.mark.parametrize("count", [0, 3])
def test_no_gaussians_and_nothing_touched(cls, count):
    gaussians = make_gaussians(count)
    optimizer = ready(cls(), gaussians)
    optimizer.step(gaussians, make_gradients(2, count), STEP)
    before, state = clone(gaussians), {name: value.clone() for name, value in optimizer.state_dict().items()}
    gradients = make_gradients(2, count, size=0.0)
    gradients.touched[:] = False
    optimizer.step(gaussians, gradients, STEP)
    assert equal(gaussians, before)
    assert all(torch.equal(value, state[name]) for name, value in optimizer.state_dict().items())


@pytest.mark.parametrize("cls", OPTIMIZERS)
def test_state_follows_rows(cls):
    gaussians = make_gaussians(5)
    optimizer = ready(cls(), gaussians)
    for seed in range(3):
        optimizer.step(gaussians, make_gradients(2, 5, seed), STEP)
    old = {name: value.clone() for name, value in optimizer.state_dict().items()}
    source, fresh = torch.tensor([4, 0, 0, 2]), torch.tensor([False, False, True, False])
    optimizer.apply(RowUpdate(source, fresh, {}, reset=("opacities", "shN")))
    for name, value in optimizer.state_dict().items():
        if name == "skipped":
            continue
        expected = old[name][source]
        if name != "steps":  # a new row has its source's count
            expected[2] = 0
        if name in ("exp_avg", "exp_avg_sq"):
            expected[:, 13] = 0
        elif name.endswith("shN"):
            expected.zero_()
        assert torch.equal(value, expected), name


@pytest.mark.parametrize("cls", [*OPTIMIZERS, DenseAdam])
def test_a_step_before_setup_is_refused_by_name(cls):
    assert_refused("set up, by setup", cls().step, make_gaussians(3), make_gradients(1, 3, 0), STEP)


@pytest.mark.parametrize("cls", [*OPTIMIZERS, DenseAdam])
def test_resumed_is_bit_identical_and_another_models_state_is_refused(cls):
    """Six steps at once, and with the state taken over by another optimizer after three."""
    whole, parts = make_gaussians(6, dtype=torch.float32), make_gaussians(6, dtype=torch.float32)
    first, second, resumed = ready(cls(), whole), ready(cls(), parts), cls()
    for seed in range(6):
        gradients = make_gradients(3, 6, seed, torch.float32)
        first.step(whole, gradients, STEP)
        if seed == 3:
            resumed.setup(parts)
            resumed.load_state_dict(second.state_dict())
        (second if seed < 3 else resumed).step(parts, gradients, STEP)
    assert equal(whole, parts)
    optimizer, other = ready(cls(), make_gaussians(4)), ready(cls(), make_gaussians(5))
    for state, found in ((other.state_dict(), r"shape \(5, \d+\), expected shape \(4, \d+\)"), ({}, "nothing")):
        assert_refused(found, optimizer.load_state_dict, state)
