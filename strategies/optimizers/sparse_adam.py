"""Adam on the Gaussians that an iteration touched, each with its own step count."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from turbogs_plugin.engine.moments import GaussianMoments, check_moments_config
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.errors import require
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.types import GaussianGradients, Gaussians, RowUpdate, Step


@dataclass
class SparseAdam:
    """Adam (Kingma & Ba 2015) that leaves alone the Gaussians that no sampled pixel saw.

    A Gaussian that no sample touched keeps its parameters, moments and step count, so momentum does not move it. A
    Gaussian with a non-finite gradient is left alone too, and counted.

    An optimizer of another `kind` on the same moments inherits from this one, as `MomentLMOptimizer` does.

    Args:
        learning_rates: rate of each parameter over the run.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to sqrt(v); no setting. 3DGS's value: gradients of a mean loss over a million pixels are far below
            Adam's customary 1e-8.
    """

    learning_rates: LearningRates = field(default_factory=LearningRates)
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = field(default=1e-15, metadata={"setting": False})
    moments: GaussianMoments = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_settings(self)
        check_moments_config(self.beta1, self.beta2, self.eps)

    @property
    def kind(self) -> str:
        """The kind of the rule, one of `layout.UPDATE_KINDS`."""
        return "adam"

    @property
    def per_view(self) -> bool:
        return self.kind != "adam"

    @property
    def skipped(self) -> Tensor:
        """[] int64 on the device: updates left out because of a non-finite gradient."""
        return self.moments.skipped

    def setup(self, gaussians: Gaussians) -> None:
        self.moments = GaussianMoments.zeros(gaussians)

    def rule(self, step: Step) -> UpdateRule:
        """The rule of this iteration's step."""
        return UpdateRule(self.learning_rates.at(step), self.beta1, self.beta2, self.eps, self.kind)

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, step: Step) -> None:
        require("moments" in vars(self), "optimizer", type(self).__name__, "set up, by setup(gaussians) before step")
        apply_update(self.rule(step), gaussians, gradients, self.moments)

    def apply(self, update: RowUpdate) -> None:
        self.moments.apply(update)

    def state_dict(self) -> dict[str, Any]:
        return self.moments.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.moments.load_state_dict(state)
