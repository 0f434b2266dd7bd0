"""Error-driven density control as a gsplat `Strategy`: named in the place of `DefaultStrategy`, nothing else edited."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from turbogs_plugin.errors import InputError, require
from turbogs_plugin.gsplat_bridge.gaussian_errors import WITHOUT_GRADIENT, iteration_stats
from turbogs_plugin.gsplat_bridge.host import (
    GEOMETRY,
    GROUND_TRUTH,
    PREDICTION,
    Optimizers,
    Parameters,
    host_gaussians,
    require_keys,
    require_one_process,
    role_of,
)
from turbogs_plugin.gsplat_bridge.optimizer_swap import COUNT
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.strategies.checks import require_each
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.rows import add_stats, finite_rows
from turbogs_plugin.types import GaussianStats, RowUpdate, Step

_STATS = tuple(GaussianStats.__dataclass_fields__)
_AS_GSPLAT = {"grad2d": "grad_sums", "count": "view_counts"}
"""Keys that gsplat's state has for the same sums."""
_ANNOUNCEMENTS = {
    "error": f"error-driven, by info['{PREDICTION}'] and info['{GROUND_TRUTH}']",
    "gradient": "driven by squares of screen gradients; to rank Gaussians by error, as the paper does, add before "
    "loss.backward(): info.update(prediction=colors, ground_truth=pixels)",
}


@dataclass
class TurboDensityStrategy(DefaultStrategy):
    """`ErrorDrivenDensity` behind the protocol of gsplat's strategies.

    A subclass of `DefaultStrategy`, since trainers branch on that. Its fields keep their meaning but for those below,
    and may change at any time. Opacities are never reset; reset_every only says when pruning by size begins.
    grow_scale2d has no effect.

    Gaussians grow and go by `squares`, here the sums over views of squared absolute screen gradients. As many grow as
    pass the threshold; which ones is drawn in proportion to squares. Once a line ``info.update(prediction=colors,
    ground_truth=pixels)`` stands before ``loss.backward()``, Gaussians are ranked by the error they carry (see
    `gaussian_errors`), as in the paper. The first step prints which of the two it is, and later steps must agree.

    Threshold, split and draw are by default those of `configs/turbogs.yaml`; there is no final pruning and no bound on
    sizes. The shares of opacity and of Gaussians that an event takes are smaller than there: gsplat's 144 events
    together take as much as 33 events of TurboGS.

    Args:
        absgrad: go by absolute gradients; render with ``absgrad=True`` then. Otherwise by the signed ones.
        grow_absgrad2d, grow_grad2d: thresholds of a view's mean absolute and signed gradient. By squares one of them
            counts, as absgrad says; by errors it suffices to pass either.
        grow_scale3d: percent_dense of `ErrorDrivenDensity`.
        top_fraction, opacity_decay: as of `ErrorDrivenDensity`; the former by errors alone.
        prune_score_fraction: as of `ErrorDrivenDensity`. None: 0.012 by squares, 0 by errors.
        prune_scale3d: as gsplat's, whose default of 0.1 takes away sky and hills. 0: no Gaussian is too large.
        max_gaussians: never more, from the first refinement on.
    """

    grow_grad2d: float = 2e-4
    grow_scale3d: float = 0.0033
    absgrad: bool = True
    grow_absgrad2d: float = 6e-4
    top_fraction: float = 0.9
    max_gaussians: int = 0
    prune_score_fraction: float | None = None
    prune_scale3d: float = 0.0
    opacity_decay: float = 0.11

    def __post_init__(self) -> None:
        if pause := self.pause_refine_after_reset:
            warnings.warn(f"pause_refine_after_reset={pause} has no effect: opacities are never reset", stacklevel=3)
        self._require_fields()
        self._controller(0)  # checks the rest

    def _require_fields(self) -> None:
        """Raise `InputError` for a field of another type or out of bounds, by name: hosts change them at any time."""
        require(not self.revised_opacity, "revised_opacity", self.revised_opacity, "False: splits copy the opacity")
        key = self.key_for_gradient
        require(key == "means2d", "key_for_gradient", key, "'means2d': error sums are of 3D Gaussians")
        for name in ("absgrad", "verbose"):
            require(vars(self)[name] in (False, True), name, vars(self)[name], "True or False")
        thresholds = ("grow_grad2d", "grow_absgrad2d", "grow_scale3d", "prune_scale2d", "prune_scale3d")
        require_each(self, lambda value: 0 <= value < math.inf, "a finite number >= 0", *thresholds)
        require_each(self, lambda value: 0 <= value < 1, "at least 0 and less than 1", "prune_opa")
        require_each(self, lambda value: value >= 0 and value % 1 == 0, "a whole number >= 0", "reset_every")
        require_each(self, lambda value: value >= 1 and value % 1 == 0, "a whole number >= 1", "refine_every")
        iterations = ("refine_start_iter", "refine_stop_iter", "refine_scale2d_stop_iter")
        require_each(self, lambda value: value % 1 == 0, "a whole number", *iterations)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """The running state, to be passed to both hooks: `GaussianStats`' tensors by name, once the first step made
        them, so that gsplat's own operations carry them along."""
        return {"scene_scale": scene_scale, **dict.fromkeys(("driven_by", "refined", *_STATS, *_AS_GSPLAT))}

    def _grow_gs(self, *arguments: Any, **options: Any) -> Any:
        """Private operations of `DefaultStrategy` that some hosts call: refused by name."""
        raise InputError("call step_post_backward of TurboDensityStrategy, which has no _update_state or _grow_gs")

    _prune_gs = _update_state = _grow_gs

    def step_pre_backward(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """To be called before ``loss.backward()``. Raises `InputError`: a wrong field; `info` without a gradient."""
        require_one_process("TurboDensityStrategy")
        self._require_fields()
        require_keys(info, ("means2d",), "info", "pass what the rasterization returned")
        if not info["means2d"].requires_grad:
            raise InputError(WITHOUT_GRADIENT)
        super().step_pre_backward(params, optimizers, state, step, info)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any] | Sequence[dict[str, Any]],
        packed: bool = False,
        scene: Any = None,
        **host_options: Any,
    ) -> None:
        """To be called after the optimizers' steps. Changes `params`, `optimizers` and `state` in place.

        Args:
            info: of the step's render; where it has several, of all of them. A host may also call this for one after
                the other: then the first call refines, and what follows within that step no longer counts.
            packed, host_options: not used. scene: of gsplat from 1.6 on, a container with more arrays over Gaussians.

        Raises:
            InputError: a field is not valid; the host trains in several processes; `state` is not one of
                `initialize_state`, or was not carried along when rows changed; `info` lacks a key, or changed between
                having errors and none; no Gaussian is finite.
        """
        require_one_process("TurboDensityStrategy")
        self._require_fields()
        if step >= self.refine_stop_iter or (state or {}).get("refined") == step:
            return
        gaussians = host_gaussians(params, GEOMETRY)
        infos = [info] if isinstance(info, dict) else info
        for each in infos:
            window = self._accumulate(state, each, len(gaussians))
        if not infos or step <= self.refine_start_iter or step % self.refine_every:
            return
        controller = self._controller(step, state["driven_by"])
        controller.stats = window
        stop = self.refine_stop_iter
        now = Step(step, stop, stop - 1, scene_extent=state["scene_scale"])
        if lost := int((~finite_rows(gaussians)).sum()):
            gone = f"step {step}: {lost} of {len(gaussians)} Gaussians are not finite"
            remedy = "look for a loss or a gradient of nan or inf"
            if lost == len(gaussians):
                raise InputError(f"{gone}: {remedy}")
            warnings.warn(f"{gone} and go; {remedy}", stacklevel=2)
        update = controller.update(gaussians, now)  # zeroes the window
        if update is None:
            return
        state["refined"] = step
        apply_row_update(in_order_of_space(update, gaussians, now), params, optimizers, state, scene)
        if self.verbose:
            grown = f"{update.num_cloned} GSs duplicated, {update.num_split} split"
            print(f"Step {step}: {grown}, {update.num_pruned} pruned. Now having {len(params['means'])} GSs.")

    def _accumulate(self, state: dict[str, Any], info: dict[str, Any], count: int) -> GaussianStats:
        """Add this iteration's statistics to those in `state`; returns the latter."""
        remedy = "pass the dict of TurboDensityStrategy.initialize_state()"
        require_keys(state, ("scene_scale", "driven_by", *_STATS), "the state", remedy)
        state["refined"] = None  # in this step
        stats, has_errors = iteration_stats(info, count, self.absgrad)
        driven_by = "error" if has_errors else "gradient"
        if state["driven_by"] is None:
            print(f"TurboDensityStrategy: {_ANNOUNCEMENTS[driven_by]}.")
            if has_errors and (most := float(info[GROUND_TRUTH].max())) > 2:
                raise InputError(f"info['{GROUND_TRUTH}'] has values up to {most:g}: expected 0 .. 1")
            if self.absgrad and not has_errors and self.grow_grad2d != TurboDensityStrategy.grow_grad2d:
                remedy = "set grow_absgrad2d, or go by signed gradients by absgrad=False"
                warnings.warn(f"grow_grad2d={self.grow_grad2d:g} has no effect: {remedy}", stacklevel=4)
            state.update(vars(GaussianStats.zeros(count, stats.view_counts.device)), driven_by=driven_by)
        if state["driven_by"] != driven_by:
            remedy = f"put '{PREDICTION}' and '{GROUND_TRUTH}' into info at every step, or at none"
            raise InputError(f"density control was {state['driven_by']}-driven, now {driven_by}-driven: {remedy}")
        if not has_errors:
            stats.weight_sums = stats.view_counts  # by which a Gaussian counts as seen
        if not self.absgrad:
            stats.absgrad_sums = stats.grad_sums
        elif getattr(info["means2d"], "absgrad", None) is None:
            raise InputError("info['means2d'] has no absgrad: render with absgrad=True, or use absgrad=False here")
        for name in _STATS:
            if len(state[name]) != count:
                remedy = "rows were added or removed without passing this state along"
                raise InputError(f"state['{name}'] has {len(state[name])} rows, the parameters {count}: {remedy}")
        window = GaussianStats(**{name: state[name] for name in _STATS})
        add_stats(window, stats)
        state.update({key: state[name] for key, name in _AS_GSPLAT.items()})
        return window

    def _controller(self, step: int, driven_by: str = "gradient") -> ErrorDrivenDensity:
        """The controller with the present values of all fields."""
        same = ("refine_every", "top_fraction", "max_gaussians", "opacity_decay")
        by_errors, removed = driven_by == "error", self.prune_score_fraction
        return ErrorDrivenDensity(
            **{name: getattr(self, name) for name in same},
            refine_from=max(0, self.refine_start_iter + 1),
            grad_threshold=self.grow_grad2d,
            absgrad_threshold=self.grow_absgrad2d if self.absgrad else self.grow_grad2d,
            percent_dense=self.grow_scale3d,
            split="long_axis",
            choose_by="difficulty" if by_errors else "squares",
            prune_score_fraction=removed if removed is not None else 0.0 if by_errors else 0.012,
            final_keep=1.0,  # a host's run may end at any step
            prune_opacity=self.prune_opa,
            prune_world_size=self.prune_scale3d,
            prune_screen_size=self.prune_scale2d if step < self.refine_scale2d_stop_iter else 0.0,
            prune_size_from=self.reset_every / max(1, self.refine_stop_iter),
        )


@torch.no_grad()
def apply_row_update(
    update: RowUpdate, params: Parameters, optimizers: Optimizers, state: dict[str, Any], scene: Any = None
) -> None:
    """Carry a `RowUpdate` out on a gsplat host: its parameters, its optimizers' state and a strategy's running state.

    Args:
        update: new rows; parameters that it does not know are copied row by row.
        params, optimizers, state: as in gsplat's operations; changed in place.
        scene: a `gsplat.scene.Scene`, as gsplat's operations take it from 1.6 on, or None. Its hooks are called,
            by which `GaussianScene` keeps `component_index` and `signal`: row i becomes a copy of old row `source[i]`.
    """
    count = len(params["means"])
    for name, parameter in [*params.items()]:
        role = role_of(name, params)
        value = update.values[role] if role in update.values else parameter.detach()[update.source]
        value = value.reshape(len(value), *parameter.shape[1:])  # a host's own layout
        replaced = torch.nn.Parameter(value, requires_grad=parameter.requires_grad)
        params[name] = replaced
        if name in optimizers:
            optimizer = optimizers[name]
            rows = optimizer.state.pop(parameter, {})
            for key in [key for key, kept in rows.items() if key != COUNT and _of_rows(kept, count)]:
                rows[key] = update.apply_state(rows[key])
                if role in update.reset:
                    rows[key].zero_()
            optimizer.state[replaced] = rows
            for group in optimizer.param_groups:
                group["params"] = [replaced]
    for key, value in state.items():  # as by gsplat's operations, a host's own values go from parent to child
        if _of_rows(value, count):
            ours = key in _STATS or key in _AS_GSPLAT
            state[key] = update.apply_state(value) if ours else value[update.source]
    if scene is not None:  # any choice of rows is a copy of them behind the old ones, which then go
        scene.on_duplicate(update.source)
        scene.on_remove(torch.arange(count + len(update.source), device=update.source.device) < count)


def _of_rows(value: Any, count: int) -> bool:
    """Whether a value has a row for each of `count` Gaussians."""
    return isinstance(value, Tensor) and value.dim() > 0 and len(value) == count
