"""torch.optim.Adam on every Gaussian in every iteration, as gsplat's trainer has it: for baselines and comparison."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from turbogs_plugin.engine.moments import check_state
from turbogs_plugin.engine.reference.update import clipped
from turbogs_plugin.errors import require
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.types import PARAMETER_NAMES, GaussianGradients, Gaussians, RowUpdate, Step

OPTIONS: dict[str, Any] = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
OPTIONS |= {"weight_decay": 0.0, "amsgrad": False, "maximize": False}
"""Adam's options, gsplat's values: decays of the moments, and eps, which is added to sqrt(v)."""


@dataclass
class DenseAdam:
    """Adam (Kingma & Ba 2015) by torch's own fused kernels, on all N Gaussians.

    A Gaussian that no sample touched has a gradient of zero: unlike in `SparseAdam`, its moments decay, and its
    momentum still moves it. The bias correction counts iterations of the run. Unlike in `torch.optim.Adam`, an
    iteration whose samples touched nothing changes nothing (on the GPU, iterations that will be repeated are of this
    kind), and a Gaussian with a non-finite gradient is treated as untouched, and counted.

    Args:
        learning_rates: rate of each parameter over the run.
        opacity_reg: weight of the mean opacity, after the sigmoid, in the objective.
        scale_reg: weight of the mean standard deviation, world units, in the objective. Both are terms of 3DGS-MCMC's
            loss (Kheradmand et al. 2024; 0.01 each in gsplat's trainer). A `SparseLoss` sees only colours, so their
            gradients are added here, before the moments.
    """

    learning_rates: LearningRates = field(default_factory=LearningRates)
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
    moments = None  # only an `UpdateRule` has them; here torch keeps its own
    per_view = False
    exp_avg: Gaussians = field(init=False, repr=False)
    exp_avg_sq: Gaussians = field(init=False, repr=False)
    counts: Tensor = field(init=False, repr=False)
    skipped: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_settings(self)

    def setup(self, gaussians: Gaussians) -> None:
        self.exp_avg, self.exp_avg_sq = (gaussians.map(torch.zeros_like) for _ in range(2))
        # Torch's kernel needs a count for each parameter.
        self.counts = torch.zeros(len(PARAMETER_NAMES), device=gaussians.device)
        self.skipped = torch.zeros((), dtype=torch.int64, device=gaussians.device)

    def rule(self, step: Step) -> None:
        """None: no engine makes this step."""

    @torch.no_grad()
    def step(self, gaussians: Gaussians, gradients: GaussianGradients, step: Step) -> None:
        require("counts" in vars(self), "optimizer", type(self).__name__, "set up, by setup(gaussians) before step")
        sums = Gaussians(**{name: gradients.summed(name) for name in PARAMETER_NAMES})
        finite, touched = sums.finite_rows(), gradients.touched
        self.skipped += (touched & ~finite).sum()
        rates = self.learning_rates.at(step)
        # Torch's way of skipping an iteration without waiting for the device.
        nothing = (~touched.any()).to(torch.float32)
        for count, (name, parameter) in zip(self.counts.unbind(), gaussians.items(), strict=True):
            gradient = getattr(sums, name)
            rows = finite.reshape(-1, *[1] * (gradient.dim() - 1))
            gradient = clipped(torch.where(rows, gradient, 0.0)).contiguous()
            if name == "opacities" and self.opacity_reg > 0:
                opacity = torch.sigmoid(parameter)
                gradient += self.opacity_reg / max(1, parameter.numel()) * opacity * (1 - opacity)
            if name == "scales" and self.scale_reg > 0:
                gradient += clipped(self.scale_reg / max(1, parameter.numel()) * parameter.exp())
            exp_avg, exp_avg_sq = (getattr(moments, name) for moments in (self.exp_avg, self.exp_avg_sq))
            options = {"fused": True, "found_inf": nothing, "lr": getattr(rates, name), **OPTIONS}
            adam([parameter], [gradient], [exp_avg], [exp_avg_sq], [], [count], **options)

    def apply(self, update: RowUpdate) -> None:
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name, value in moments.items():
                setattr(moments, name, update.apply_state(value))
            for name in update.reset:
                getattr(moments, name).zero_()

    def state_dict(self) -> dict[str, Any]:
        moments = {"exp_avg": self.exp_avg, "exp_avg_sq": self.exp_avg_sq}
        rows = {f"{moment}.{name}": value for moment, values in moments.items() for name, value in values.items()}
        return {**rows, "counts": self.counts, "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved state. Raises `InputError` if its number of Gaussians or bands is another."""
        present = self.state_dict()
        check_state(state, present)
        for name, value in present.items():
            value.copy_(state[name])
