"""gsplat's MCMCStrategy behind our protocol, for comparison, without an edit to gsplat. Needs a GPU, as its ops do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from gsplat.strategy import MCMCStrategy
from turbogs_plugin.strategies.density_gsplat import marking_optimizer, touched_rows
from turbogs_plugin.strategies.learning_rates import LearningRates

from turbogs_plugin.errors import InputError, require
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step


@dataclass
class GsplatMcmcDensity:
    """gsplat's relocation, growth and noise (Kheradmand et al. 2024), run on our parameters.

    The noise on the means, which is part of every iteration, is added in place. What makes the method's dead Gaussians
    in the first place are regularisers of opacity and scale in the *loss* (0.01 each in gsplat's trainer); a
    `SparseLoss` sees colours only, so they are not here: fewer Gaussians die and move than in gsplat's trainer.
    It stops relocating and growing at `Step.refine_until` (its `refine_stop_iter`).

    Args:
        cap_max, noise_lr, refine_start_iter, refine_every, min_opacity: as in `gsplat.MCMCStrategy`.
        learning_rates: those of the optimizer; the noise follows the means' rate.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_every: int = 100
    min_opacity: float = 0.005
    learning_rates: LearningRates = field(default_factory=LearningRates)

    def __post_init__(self) -> None:
        for name in ("cap_max", "refine_every"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(self.noise_lr >= 0, "noise_lr", self.noise_lr, "0 or more")
        require(0 < self.min_opacity < 1, "min_opacity", self.min_opacity, "more than 0 and less than 1")

    @property
    def stats(self) -> GaussianStats | None:
        return None

    def setup(self, gaussians: Gaussians) -> None:
        if gaussians.device.type != "cuda":
            raise InputError(
                "density.type 'mcmc' needs a GPU, as gsplat's relocation does: use gsplat_default on a CPU"
            )

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        strategy = MCMCStrategy(
            cap_max=self.cap_max,
            noise_lr=self.noise_lr,
            refine_start_iter=self.refine_start_iter,
            refine_stop_iter=step.refine_until,
            refine_every=self.refine_every,
            min_opacity=self.min_opacity,
        )
        iteration = step.iteration
        refines = self.refine_start_iter < iteration < step.refine_until and iteration % self.refine_every == 0
        # Relocation writes into the tensors that it is given; where there is noise only, that is what is wanted.
        params = {
            name: torch.nn.Parameter(value.clone() if refines else value, requires_grad=False)
            for name, value in gaussians.items()
        }
        optimizers = {name: marking_optimizer(params[name]) for name in params}
        with torch.random.fork_rng(devices=[gaussians.device]):
            torch.manual_seed(int(np.random.SeedSequence([step.seed, iteration]).generate_state(1)[0]))
            rate = self.learning_rates.at(step).means
            strategy.step_post_backward(params, optimizers, strategy.initialize_state(), iteration, {}, lr=rate)
        if not refines:
            return None
        count = len(params["means"])
        source = torch.arange(count, device=gaussians.device)
        return RowUpdate(
            torch.where(source < len(gaussians), source, 0),
            touched_rows(optimizers["means"], params["means"]),
            {name: value.data for name, value in params.items()},
            num_cloned=count - len(gaussians),
        )

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
