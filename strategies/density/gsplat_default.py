"""gsplat's DefaultStrategy behind our protocol, for comparison, without an edit to gsplat."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from torch import Tensor
from turbogs_plugin.strategies.density.rows import finite_rows, loaded_rows

from turbogs_plugin.errors import require, require_not_negative
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step


class _FilledStrategy(DefaultStrategy):
    """A DefaultStrategy whose running statistics somebody else has filled in."""

    def _update_state(self, *args, **kwargs) -> None:
        pass


@dataclass
class GsplatDefaultDensity:
    """gsplat's own clone, split, prune and reset, run on our parameters and statistics.

    gsplat changes parameters and optimizer state together. Here it is handed the parameters, two optimizers whose only
    state marks rows that it has touched, and the row numbers as a running statistic of its own; what comes back
    is a `RowUpdate`. It stops at `Step.refine_until` (its `refine_stop_iter`).

    Unlike gsplat, which would train on with NaN or fail, an event first removes Gaussians that are not finite or too
    large to be split, and one Gaussian, the most opaque, is always left.

    Args:
        prune_opa, grow_grad2d, grow_scale3d, grow_scale2d, prune_scale3d, prune_scale2d, refine_scale2d_stop_iter,
            refine_start_iter, reset_every, refine_every, pause_refine_after_reset, absgrad, revised_opacity: as in
            `gsplat.DefaultStrategy`.
        opacity_reset: gsplat 1.5.3 never resets opacities (`step % reset_every == 0 & step > 0` is always false):
            `as_shipped` leaves it so, `repaired` resets every `reset_every` iterations, as its text says.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    opacity_reset: Literal["repaired", "as_shipped"] = "repaired"
    _stats: GaussianStats | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        allowed = ("repaired", "as_shipped")
        require(self.opacity_reset in allowed, "opacity_reset", self.opacity_reset, f"one of {', '.join(allowed)}")
        for name in ("refine_every", "reset_every"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(0 <= self.prune_opa < 0.5, "prune_opa", self.prune_opa, "at least 0 and less than 0.5")
        require_not_negative(
            self,
            *("grow_grad2d", "grow_scale3d", "grow_scale2d", "prune_scale3d", "prune_scale2d"),
            *("refine_scale2d_stop_iter", "refine_start_iter", "pause_refine_after_reset"),
        )

    @property
    def stats(self) -> GaussianStats | None:
        return self._stats

    def setup(self, gaussians: Gaussians) -> None:
        self._stats = GaussianStats.zeros(len(gaussians), gaussians.device)

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        if step.iteration >= step.refine_until:
            self._stats = None
        reset_due = step.iteration > 0 and step.iteration % self.reset_every == 0
        if self._stats is None or not (step.iteration % self.refine_every == 0 or reset_due) or len(gaussians) == 0:
            return None
        usable = torch.nonzero(finite_rows(gaussians)).squeeze(-1)
        if len(usable) == 0:
            return self._keep_one(gaussians, usable)
        params = {name: torch.nn.Parameter(value[usable], requires_grad=False) for name, value in gaussians.items()}
        optimizers = {name: marking_optimizer(params[name]) for name in ("means", "opacities")}
        state = self._gsplat_state(usable, step)
        strategy = _FilledStrategy(**self._gsplat_config(), refine_stop_iter=step.refine_until)
        with torch.random.fork_rng(devices=[gaussians.device] if gaussians.device.type == "cuda" else []):
            torch.manual_seed(int(np.random.SeedSequence([step.seed, step.iteration]).generate_state(1)[0]))
            strategy.step_post_backward(params, optimizers, state, step.iteration, {})
        if reset_due and self.opacity_reset == "repaired":
            reset_opa(params, optimizers, state, self.prune_opa * 2.0)
        if len(state["source_row"]) == 0:
            return self._keep_one(gaussians, usable)
        return self._change(gaussians, params, optimizers, state)

    def apply(self, update: RowUpdate) -> None:
        if self._stats is not None:
            self._stats = self._stats.map(update.apply_state)

    def state_dict(self) -> dict[str, Any]:
        if self._stats is None:
            return {"stats": None}
        return {"stats": {item.name: getattr(self._stats, item.name) for item in fields(self._stats)}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._stats = loaded_rows("stats", state["stats"], self._stats)

    def _gsplat_config(self) -> dict[str, Any]:
        ours = ("opacity_reset", "_stats")
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name not in ours}

    def _gsplat_state(self, rows: Tensor, step: Step) -> dict[str, Any]:
        """gsplat's running state out of our statistics, and the row numbers, which it will treat alike. `rows`: [M]."""
        stats = self._stats
        return {
            "grad2d": (stats.absgrad_sums if self.absgrad else stats.grad_sums)[rows],
            "count": stats.view_counts[rows],
            "radii": stats.max_radii[rows],
            "source_row": rows,
            "scene_scale": step.scene_extent,
        }

    def _keep_one(self, gaussians: Gaussians, usable: Tensor) -> RowUpdate | None:
        """What there is instead of a model of nothing: the most opaque Gaussian of those that are `usable` [M]."""
        self._stats.zero_()
        if len(gaussians) == 1:
            return None
        source = usable[gaussians.opacities[usable].argmax()] if len(usable) else usable.new_zeros(())
        return RowUpdate(source.reshape(1), usable.new_zeros(1, dtype=torch.bool), {}, num_pruned=len(gaussians) - 1)

    def _change(self, gaussians: Gaussians, params: dict, optimizers: dict, state: dict) -> RowUpdate | None:
        """What gsplat has done, as one change."""
        source = state["source_row"]
        fresh, opacity_fresh = (touched_rows(optimizers[name], params[name]) for name in ("means", "opacities"))
        was_reset = bool(opacity_fresh.all()) and not bool(fresh.all())
        if not bool(state["count"].any()):  # gsplat starts a new window after a refinement
            self._stats.zero_()
        unchanged = len(source) == len(gaussians) and not was_reset and not bool(fresh.any())
        if unchanged:
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


def marking_optimizer(param: torch.nn.Parameter) -> torch.optim.Optimizer:
    """An optimizer whose one state tensor is 1 for rows it knows; gsplat puts 0 where it makes or resets rows."""
    optimizer = torch.optim.SGD([param], lr=0.0)
    optimizer.state[param]["known"] = torch.ones(len(param), device=param.device)
    return optimizer


def touched_rows(optimizer: torch.optim.Optimizer, param: torch.nn.Parameter) -> Tensor:
    """[M] bool: the rows that gsplat has made or reset."""
    return optimizer.state[param]["known"] == 0
