"""Dense Adam is torch.optim.Adam as a gsplat trainer uses it, through gsplat's own surgery too; and so is sparse Adam
where every Gaussian is touched."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.strategy.ops import duplicate, remove, reset_opa
from helpers.optimizers import STEP, equal, make_gaussians, make_gradients, ready

from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.dense_adam import DenseAdam
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES, RowUpdate

RATES = LearningRates(batch_scale=1.0)


class Reference:
    """gsplat's side: a dict of parameters, a dict of torch.optim.Adam, and its operations on rows."""

    def __init__(self, gaussians) -> None:
        self.params = {name: torch.nn.Parameter(value.clone()) for name, value in gaussians.items()}
        self.optimizers = {
            name: torch.optim.Adam([{"params": p}], lr=getattr(RATES.at(STEP), name), eps=1e-15)
            for name, p in self.params.items()
        }

    def step(self, gradients, regularizer=None) -> None:
        for name, p in self.params.items():
            p.grad = gradients.summed(name).clone()
        if regularizer is not None:
            regularizer(self.params).backward()
        for optimizer in self.optimizers.values():
            optimizer.step()

    def surgery(self, operation, **options) -> None:
        operation(params=self.params, optimizers=self.optimizers, state={}, **options)

    def assert_equals(self, gaussians) -> None:
        for name, value in gaussians.items():
            torch.testing.assert_close(value, self.params[name].data, rtol=1e-12, atol=1e-12, msg=name)


def follow(update: RowUpdate, gaussians, optimizer: DenseAdam | SparseAdam):
    optimizer.apply(update)
    return update.apply(gaussians)


def leave_untouched(gradients, seed: int):
    """The gradients of an iteration that touched about half of the Gaussians."""
    touched = torch.rand(len(gradients.touched), generator=torch.Generator().manual_seed(seed)) < 0.5
    touched[0] = True
    for name in PARAMETER_NAMES:
        value = getattr(gradients, name)
        value[(slice(None), ~touched) if name != "shN" else ~touched] = 0
    gradients.touched = touched
    return gradients


@pytest.mark.parametrize("cls", [DenseAdam, SparseAdam])
def test_equals_torch_adam_through_gsplats_surgery(cls):
    gaussians = make_gaussians(9)
    reference, optimizer = Reference(gaussians), ready(cls(RATES), gaussians)
    for seed in range(24):
        gradients = make_gradients(3, len(gaussians), seed)
        if cls is DenseAdam:
            gradients = leave_untouched(gradients, seed)
        optimizer.step(gaussians, gradients, STEP)
        reference.step(gradients)
        reference.assert_equals(gaussians)
        count = len(gaussians)
        if seed == 6:
            mask = torch.arange(count) % 3 == 1
            reference.surgery(duplicate, mask=mask)
            source = torch.cat([torch.arange(count), torch.where(mask)[0]])
            gaussians = follow(RowUpdate(source, torch.arange(len(source)) >= count, {}), gaussians, optimizer)
        if seed == 12:
            mask = torch.arange(count) % 4 == 0
            reference.surgery(remove, mask=mask)
            source = torch.where(~mask)[0]
            gaussians = follow(RowUpdate(source, torch.zeros_like(source, dtype=torch.bool), {}), gaussians, optimizer)
        if seed == 18:
            reference.surgery(reset_opa, value=0.3)
            values = {"opacities": gaussians.opacities.clamp(max=torch.logit(torch.tensor(0.3)).item())}
            same = torch.arange(count)
            update = RowUpdate(same, torch.zeros(count, dtype=torch.bool), values, reset=("opacities",))
            gaussians = follow(update, gaussians, optimizer)
    assert int(optimizer.skipped) == 0


def test_regularizers_are_those_of_gsplats_loss():
    """gsplat's trainer adds the means of opacities and scales to its loss; autograd says what follows."""
    gaussians = make_gaussians(9)
    reference = Reference(gaussians)
    optimizer = ready(DenseAdam(RATES, opacity_reg=0.02, scale_reg=0.03), gaussians)

    def regularizer(params):
        return 0.02 * torch.sigmoid(params["opacities"]).abs().mean() + 0.03 * torch.exp(params["scales"]).abs().mean()

    for seed in range(10):
        gradients = leave_untouched(make_gradients(1, 9, seed), seed)
        optimizer.step(gaussians, gradients, STEP)
        reference.step(gradients, regularizer)
    reference.assert_equals(gaussians)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_non_finite_gradient_counts_as_untouched(name, bad):
    clean, dirty = make_gaussians(5), make_gaussians(5)
    optimizers = [ready(DenseAdam(RATES), gaussians) for gaussians in (clean, dirty)]
    for index, gaussians in enumerate((clean, dirty)):
        optimizers[index].step(gaussians, make_gradients(3, 5), STEP)
        gradients = make_gradients(3, 5, seed=2)
        if index == 0:
            for parameter in PARAMETER_NAMES:
                value = getattr(gradients, parameter)
                (value[2] if parameter == "shN" else value[:, 2]).fill_(0.0)
        else:
            value = getattr(gradients, name)
            (value[2] if name == "shN" else value[1, 2]).fill_(bad)
        optimizers[index].step(gaussians, gradients, STEP)
    assert equal(clean, dirty)
    assert [int(optimizer.skipped) for optimizer in optimizers] == [0, 1]
