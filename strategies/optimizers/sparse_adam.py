"""Adam on the Gaussians that an iteration touched, each with its own step count."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from turbogs_plugin.strategies.learning_rates import LearningRates

from turbogs_plugin.engine.rendered import ScreenGradients
from turbogs_plugin.engine.update_rule import (
    GaussianMoments,
    UpdateRule,
    add_packed,
    add_shN,
    advance,
    check_moments_config,
    clipped,
    packed_rows,
    take_fused_step,
    updatable,
)
from turbogs_plugin.types import Gaussians, RowUpdate, Step


@dataclass
class SparseAdam:
    """Adam (Kingma & Ba 2015) that leaves alone what no sampled pixel saw.

    A Gaussian that no sample touched keeps its parameters, moments and step count, so momentum does not move what
    this iteration knows nothing of. One with a non-finite gradient is left alone too, and counted.

    Args:
        learning_rates: of each parameter over the run.
        beta1, beta2: decay of the moments.
        eps: added to sqrt(v). 3DGS's value: gradients of a mean loss over a million pixels are far below Adam's
            customary 1e-8.
    """

    learning_rates: LearningRates = field(default_factory=LearningRates)
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    moments: GaussianMoments = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_moments_config(self.beta1, self.beta2, self.eps)

    def setup(self, gaussians: Gaussians) -> None:
        self.moments = GaussianMoments.zeros(gaussians)

    @property
    def skipped(self) -> torch.Tensor:
        """[] int64 on the device: updates left out because of a non-finite gradient."""
        return self.moments.skipped

    def rule(self, step: Step) -> UpdateRule:
        """The rule of this iteration's step."""
        return UpdateRule(self.learning_rates.at(step), self.beta1, self.beta2, self.eps)

    @torch.no_grad()
    def step(self, gaussians: Gaussians, gradients: ScreenGradients, step: Step) -> None:
        rule, moments = self.rule(step), self.moments
        if take_fused_step(gaussians, gradients, moments, rule):
            return
        parameter_gradients = gradients.parameter_gradients(rows=False)
        index = updatable(parameter_gradients, moments)
        moments.steps[index] += 1
        steps = moments.steps[index]
        gradient = packed_rows(parameter_gradients, index).sum(dim=0)
        terms = advance(moments.exp_avg, moments.exp_avg_sq, gradient, index, steps, rule)
        add_packed(gaussians, index, terms.delta(rule.packed_rates(gradient)))
        step_shN(gaussians, parameter_gradients.shN, moments, index, steps, rule)

    def apply(self, update: RowUpdate) -> None:
        self.moments.apply(update)

    def state_dict(self) -> dict[str, Any]:
        return self.moments.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.moments.load_state_dict(state)


def step_shN(
    gaussians: Gaussians,
    gradient: torch.Tensor,
    moments: GaussianMoments,
    index: torch.Tensor,
    steps: torch.Tensor,
    rule: UpdateRule,
) -> None:
    """Adam's step of the higher bands (appendix, second half of the LM equation), which no block takes in.

    Args:
        gradient: [N, B, 3].
        index: [n] the Gaussians to update; steps: [n] their step counts, this one included.
    """
    gradient = clipped(gradient[index].flatten(1))
    terms = advance(moments.exp_avg_shN, moments.exp_avg_sq_shN, gradient, index, steps, rule)
    add_shN(gaussians, index, terms.delta(rule.rates.shN))
