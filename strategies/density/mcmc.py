"""gsplat's MCMCStrategy behind our protocol, for comparison, without an edit to gsplat. Needs a GPU, as its ops do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from gsplat.strategy import MCMCStrategy
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.checks import require_at_least_one, require_settings
from turbogs_plugin.strategies.density.gsplat_default import new_rows, run_gsplat
from turbogs_plugin.strategies.density.rows import finite_rows
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Gaussians, RowUpdate, Step

DEAD_LOGIT = -50.0
"""Opacity logit given to Gaussians that must be relocated."""

LARGEST_LOG_SCALE = 40.0
"""Larger Gaussians are relocated: noise in proportion to their covariance could overflow in float32."""


@dataclass
class GsplatMcmcDensity(DensityController):
    """gsplat's relocation, growth and noise (Kheradmand et al. 2024), run on our parameters.

    The noise on the means, which is part of every iteration, is added in place. The method's dead Gaussians come from
    terms of opacity and scale in the objective: `DenseAdam`'s `opacity_reg` and `scale_reg`, which
    ``configs/mcmc.yaml`` sets. Relocation and growth stop at `Step.refine_until` (gsplat's `refine_stop_iter`).

    Three rules avoid cases in which gsplat would fail or go on training with NaN. A Gaussian that is not finite, or too
    large, counts as dead. Noise that is not finite is left out. An event without living Gaussians relocates and adds
    none. All other settings are gsplat's own defaults.

    Args:
        max_gaussians: most Gaussians, `cap_max` of `gsplat.MCMCStrategy`.
        refine_start_iter: iteration after which Gaussians are relocated and added.
        refine_every: interval of relocation and growth.
        learning_rates: learning rates of the optimizer. The noise uses the means' rate of the next iteration, as in
            gsplat's trainer, where the schedulers step first.
    """

    max_gaussians: int = 1_000_000
    refine_start_iter: int = MCMCStrategy.refine_start_iter
    refine_every: int = MCMCStrategy.refine_every
    learning_rates: LearningRates = field(default_factory=LearningRates)
    moves_model = True  # its noise

    def __post_init__(self) -> None:
        require_at_least_one(self, "max_gaussians", "refine_every")
        require_settings(self)

    def setup(self, gaussians: Gaussians) -> None:
        if gaussians.device.type != "cuda":
            raise InputError(
                "density.type 'mcmc' needs a GPU, as gsplat's relocation does: use gsplat_default on a CPU"
            )

    def event_due(self, step: Step) -> bool:
        within = self.refine_start_iter < step.iteration < step.refine_until
        return within and step.iteration % self.refine_every == 0

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        if len(gaussians) == 0:
            return None
        if self.event_due(step):
            usable = finite_rows(gaussians) & (gaussians.scales.amax(dim=-1) <= LARGEST_LOG_SCALE)
            if bool((usable & (torch.sigmoid(gaussians.opacities) > MCMCStrategy.min_opacity)).any()):
                return self._refine(gaussians, usable, step)
        self._add_noise(gaussians, step)
        return None

    def _refine(self, gaussians: Gaussians, usable: Tensor, step: Step) -> RowUpdate:
        """Relocation, growth and noise, on copies: relocation writes into the tensors that it is given.

        As in gsplat, a relocated Gaussian takes the parameters of its new place but keeps the state of its own row. The
        source of an added one is the row it was copied from, known because gsplat copies the row numbers too.
        """
        rows = torch.arange(len(gaussians), device=gaussians.device)
        opacities = torch.where(usable, gaussians.opacities, DEAD_LOGIT)
        copies = {name: value.clone() for name, value in gaussians.items()} | {"opacities": opacities}
        params, optimizers = self._run_gsplat(copies | {"source_row": rows.clone()}, step.refine_until, step)
        added = params.pop("source_row").data[len(rows) :]
        return RowUpdate(
            torch.cat([rows, added]),
            new_rows(params, optimizers, "means"),
            {name: value.data for name, value in params.items()},
            num_cloned=len(added),
        )

    def _add_noise(self, gaussians: Gaussians, step: Step) -> None:
        """Noise on the means, in place, where it is finite."""
        before = gaussians.means.clone()
        self._run_gsplat(dict(gaussians.items()), 0, step)
        finite = gaussians.means.isfinite().all(dim=-1, keepdim=True)
        gaussians.means.copy_(torch.where(finite, gaussians.means, before))

    def _run_gsplat(self, values: dict[str, Tensor], refine_until: int, step: Step) -> tuple[dict, dict]:
        """`run_gsplat` with gsplat's strategy and these settings."""
        strategy = MCMCStrategy(
            cap_max=self.max_gaussians,
            refine_start_iter=self.refine_start_iter,
            refine_stop_iter=refine_until,
            refine_every=self.refine_every,
        )
        rate = self.learning_rates.at(replace(step, iteration=step.iteration + 1)).means
        # gsplat's state is a table for relocation, which takes longer to make than an iteration.
        state = strategy.initialize_state() if refine_until > 0 else {"binoms": torch.empty(0)}
        return run_gsplat(strategy, values, state, step, lr=rate)
