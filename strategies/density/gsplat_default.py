"""gsplat's DefaultStrategy behind our protocol, for comparison, without an edit to gsplat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from gsplat.strategy import DefaultStrategy, Strategy
from gsplat.strategy.ops import reset_opa
from torch import Tensor

from turbogs_plugin.strategies.checks import require_at_least_one, require_settings
from turbogs_plugin.strategies.density.rows import WindowedDensity, finite_rows, keep_one, removal
from turbogs_plugin.types import Gaussians, RowUpdate, Step


class _FilledStrategy(DefaultStrategy):
    """A DefaultStrategy whose running statistics are already filled in."""

    def _update_state(self, *args, **kwargs) -> None:
        pass


@dataclass
class GsplatDefaultDensity(WindowedDensity):
    """gsplat's own clone, split, prune and reset, run on our parameters and statistics.

    gsplat gets the parameters, optimizers whose only state marks the rows that it makes or resets, and the row numbers
    as one more running statistic; a `RowUpdate` says what it did. Events end at `Step.refine_until` (gsplat's
    `refine_stop_iter`). An event first removes Gaussians that are not finite or too large to be split, on which gsplat
    would fail or go on training with NaN. One Gaussian, the most opaque, is always left. All other settings are
    gsplat's own defaults.

    Args:
        refine_start_iter: iteration after which densification begins.
        refine_every: interval of densification.
        opacity_reset: resets of opacities. gsplat 1.5.3 makes none, as `step % reset_every == 0 & step > 0` is always
            false: `as_shipped` keeps that; `repaired` resets every `DefaultStrategy.reset_every` iterations, as
            gsplat's docs say.
    """

    refine_start_iter: int = DefaultStrategy.refine_start_iter
    refine_every: int = DefaultStrategy.refine_every
    opacity_reset: Literal["repaired", "as_shipped"] = "repaired"

    def __post_init__(self) -> None:
        require_at_least_one(self, "refine_every")
        require_settings(self)

    def event_due(self, step: Step) -> bool:
        return step.iteration < step.refine_until and (step.iteration % self.refine_every == 0 or self._reset_due(step))

    def _reset_due(self, step: Step) -> bool:
        return step.iteration > 0 and step.iteration % DefaultStrategy.reset_every == 0

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        if step.iteration >= step.refine_until:
            self.stats = None
        reset_due = self._reset_due(step)
        if self.stats is None or not self.event_due(step) or len(gaussians) == 0:
            return None
        usable = torch.nonzero(finite_rows(gaussians)).squeeze(-1)
        if len(usable) == 0:
            return self._only_one(gaussians)
        strategy = _FilledStrategy(
            refine_start_iter=self.refine_start_iter, refine_every=self.refine_every, refine_stop_iter=step.refine_until
        )
        values = {name: value[usable] for name, value in gaussians.items()}
        sums = {"grad2d": self.stats.grad_sums, "count": self.stats.view_counts, "radii": self.stats.max_radii}
        state: dict[str, Any] = {name: rows[usable] for name, rows in sums.items()}
        state |= {"source_row": usable, "scene_scale": step.scene_extent}
        params, optimizers = run_gsplat(strategy, values, state, step)
        if reset_due and self.opacity_reset == "repaired":
            reset_opa(params, optimizers, state, strategy.prune_opa * 2.0)
        if len(state["source_row"]) == 0:
            return self._only_one(gaussians)
        return self._change(gaussians, params, optimizers, state)

    def _only_one(self, gaussians: Gaussians) -> RowUpdate | None:
        """The removal of all but the most opaque finite Gaussian, so that the model is never empty."""
        self.window.zero_()
        return removal(~keep_one(torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device), gaussians)[0])

    def _change(self, gaussians: Gaussians, params: dict, optimizers: dict, state: dict) -> RowUpdate | None:
        """The change that gsplat has made, as a `RowUpdate`."""
        source = state["source_row"]
        fresh, opacity_fresh = (new_rows(params, optimizers, name) for name in ("means", "opacities"))
        was_reset = bool(opacity_fresh.all()) and not bool(fresh.all())
        if not bool(state["count"].any()):  # gsplat starts a new window after a refinement
            self.window.zero_()
        if len(source) == len(gaussians) and not was_reset and not bool(fresh.any()):
            return None
        present = torch.bincount(source, minlength=len(gaussians))
        copies = torch.bincount(source[fresh], minlength=len(gaussians))
        return RowUpdate(
            source,
            fresh,
            {name: value.data for name, value in params.items()},
            reset=("opacities",) if was_reset else (),
            num_cloned=int((copies == 1).sum()),
            num_split=int((copies == 2).sum()),
            num_pruned=int((present == 0).sum()),
        )


def run_gsplat(
    strategy: Strategy, values: dict[str, Tensor], state: dict[str, Any], step: Step, **options: Any
) -> tuple[dict[str, torch.nn.Parameter], dict[str, torch.optim.Optimizer]]:
    """Run a strategy of gsplat after an optimizer's step. Seed and iteration decide its random numbers.

    Args:
        values: name -> parameter [N, ...]; some operations of gsplat change it in place.
        state: the strategy's running state, changed in place.
        options: further arguments of the strategy's `step_post_backward`.

    Returns:
        The parameters afterwards, and optimizers for `new_rows`.
    """
    params = {name: torch.nn.Parameter(value, requires_grad=False) for name, value in values.items()}
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.SGD([param], lr=0.0) for name, param in params.items()
    }
    for name, param in params.items():  # gsplat puts 0 where it makes or resets rows
        optimizers[name].state[param]["known"] = torch.ones(len(param), device=param.device)
    device = params["means"].device
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(np.random.SeedSequence([step.seed, step.iteration]).generate_state(1)[0]))
        strategy.step_post_backward(params, optimizers, state, step.iteration, {}, **options)
    return params, optimizers


def new_rows(params: dict[str, torch.nn.Parameter], optimizers: dict[str, torch.optim.Optimizer], name: str) -> Tensor:
    """[M] bool: the rows of a parameter that gsplat has made or reset since `run_gsplat` began."""
    return optimizers[name].state[params[name]]["known"] == 0
