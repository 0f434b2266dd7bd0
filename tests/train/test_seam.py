"""The trainer and its engine: what is carried out at once, and what strategies without a rule are given instead."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import pytest
import torch
from helpers.framework_runs import tiny_trainer
from helpers.losing_engine import LosingEngine

from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


@dataclass
class OwnCodeLoss:
    """A third party's loss: no terms, the same numbers."""

    inner: CharbonnierNccLoss = field(default_factory=CharbonnierNccLoss)
    terms = None

    def __call__(self, colors, targets, samples):
        return self.inner(colors, targets, samples)


class OwnCode:
    """A third party's optimizer around one of ours: no rule, the same step. `calls`: times that one iteration steps."""

    moments, calls = None, 1

    def __init__(self, inner):
        self.inner, self.per_view, self.seen = inner, inner.per_view, []

    def rule(self, step):
        return None

    def step(self, gaussians, gradients, step):
        self.seen.append(gradients)
        for _ in range(self.calls):
            self.inner.step(gaussians, gradients, step)

    def setup(self, gaussians):
        self.inner.setup(gaussians)


def run(trainer, iterations=3):
    for _ in range(iterations):
        trainer.step()
    return trainer


def assert_equal(one, other):
    for name, value in one.gaussians.items():
        assert torch.equal(value, getattr(other.gaussians, name)), name
    for name in ("errors", "stamps", "view_sums"):
        assert torch.equal(getattr(one.maps, name), getattr(other.maps, name)), name
    assert_equal_statistics(one, other)


def assert_equal_statistics(one, other):
    for item in fields(one.density.stats):
        assert torch.equal(getattr(one.density.stats, item.name), getattr(other.density.stats, item.name)), item.name


def test_a_loss_of_its_own_code_trains_as_its_rule_would(capture):
    ruled, coded = tiny_trainer(capture), tiny_trainer(capture)
    coded.loss = OwnCodeLoss(ruled.loss)
    assert_equal(run(ruled), run(coded))


@pytest.mark.parametrize("make", [MomentLMOptimizer, SparseAdam])
def test_an_optimizer_of_its_own_code_trains_as_its_rule_would(capture, make):
    ruled, coded = tiny_trainer(capture), tiny_trainer(capture)
    for trainer, optimizer in ((ruled, make()), (coded, OwnCode(make()))):
        trainer.optimizer = optimizer
        optimizer.setup(trainer.gaussians)
    assert_equal(run(ruled), run(coded))
    rows = {len(gradients.means) for gradients in coded.optimizer.seen}
    assert rows == {1} if make is SparseAdam else max(rows) > 1


@pytest.mark.parametrize("calls", [0, 2])
def test_statistics_are_written_once_whatever_the_optimizer_does(capture, calls):
    """Statistics of density control get each backward pass once, whether an optimizer makes no step of it or two."""
    usual, odd = tiny_trainer(capture), tiny_trainer(capture)
    odd.optimizer = OwnCode(MomentLMOptimizer())
    odd.optimizer.calls = calls
    odd.optimizer.setup(odd.gaussians)
    run(usual, 1)
    run(odd, 1)
    assert float(usual.density.stats.view_counts.sum()) > 0
    assert_equal_statistics(odd, usual)


@pytest.mark.parametrize("choose_by", ["difficulty", "squares"])
def test_errors_are_carried_to_the_gaussians_for_a_control_that_uses_them(capture, choose_by):
    trainer = tiny_trainer(capture)
    trainer.density.choose_by = choose_by
    run(trainer, 1)
    assert bool(trainer.density.stats.error_sums.any()) == (choose_by == "difficulty")
    assert trainer.density.stats.square_sums.any() and trainer.density.stats.weight_sums.any()


class Restless:
    """A density control that moves every mean in each iteration, without a change of the set of Gaussians."""

    moves_model, stats, uses_errors = True, None, False

    def setup(self, gaussians):
        pass

    def event_due(self, step):
        return False

    def update(self, gaussians, step):
        gaussians.means += 1.0


def test_what_density_control_moves_in_a_skipped_iteration_is_taken_back(capture):
    trainer = tiny_trainer(capture)
    trainer.engine, trainer.density = LosingEngine(lose=2), Restless()
    run(trainer, 1)
    before = trainer.gaussians.map(torch.Tensor.clone)
    run(trainer, 1)  # the pass has too little memory: nothing changes
    for name, value in trainer.gaussians.items():
        assert torch.equal(value, getattr(before, name)), name
    trainer.engine.recover()
    run(trainer, 1)
    assert (trainer.gaussians.means - before.means).mean() == pytest.approx(1.0, abs=0.05)
