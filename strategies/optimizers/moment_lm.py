"""Moment-damped Levenberg-Marquardt on two small blocks per Gaussian (paper section 3.9 and appendix)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.sparse_adam import step_shN

from turbogs_plugin.engine.reference.lm_solvers import solve_low_rank, solve_scaled_cholesky
from turbogs_plugin.engine.rendered import ScreenGradients
from turbogs_plugin.engine.update_rule import (
    APPEARANCE,
    GEOMETRY,
    AdamTerms,
    GaussianMoments,
    MomentLMParams,
    UpdateRule,
    add_packed,
    advance,
    check_moments_config,
    packed_rows,
    take_fused_step,
    updatable,
)
from turbogs_plugin.errors import require, require_not_negative
from turbogs_plugin.types import Gaussians, RowUpdate, Step

_SOLVERS = {"cholesky": solve_scaled_cholesky, "low_rank": solve_low_rank}


@dataclass
class MomentLMOptimizer:
    """Moment-damped LM on a geometry block (mean 3, scale 3, quaternion 4) and an appearance block (band 0, opacity);
    Adam on the higher bands.

    With g_k a Gaussian's gradient in view k, L_k its share of the loss there, m and v Adam's bias-corrected moments of
    the summed gradient and eta the learning rates, `units: balanced` solves

        (sum_k curvature * g_k g_k^T / L_k + diag((sqrt(v) + eps) / eta)) delta = -m.

    A loss of c times the size (c L_k, c g_k) gives the same delta, and without rows delta is Adam's step exactly.
    Where the gradients of the views agree that an Adam step would overshoot the loss there is, delta stops short.
    That needs shares and gradients of one loss. What the renderers give as L_k is the share of the L1 error summed over
    the three channels and averaged over the samples, `GaussianGradients.view_losses`, whatever loss the gradients are
    of. Two things follow. For a loss that is a mean over channels too, as ours are, L_k is 3 times its share, and
    `curvature` acts as a third of itself. And a loss multiplied by c on the way (a sum instead of a mean, loss scaling)
    multiplies the rows' term by c against Adam's, which shortens the steps where c > 1, unless its shares are
    multiplied alike.
    `units: paper` is the printed equation, (J^T J + diag(sqrt(v) + eps)) delta = -m with m and v as they are and
    the g_k as rows of J: it has no learning rate and changes with the unit of the loss. It is there to compare.

    Args:
        learning_rates: of each parameter over the run.
        beta1, beta2: decay of the moments.
        eps: added to sqrt(v). The default is small enough that a loss scaled by 1e-6 gives the same steps down to
            gradients of 1e-12, and not below what v can hold: where g^2 underflows in float32 (|g| < 1.2e-21), m / eps
            is still less than one.
        units: see above.
        rows: one row of J per view, or one of their sum (rank 1).
        solver: factorise the D x D system of each block, or the K x K system of its rows: one answer. In float32, with
            stiff rows (scaled length 50, K = 3), `low_rank` is off by 4e-7 of Adam's step, `cholesky` by 1e-4.
        curvature: for L_k that are true shares, 1/2 is Gauss-Newton for a loss r^2 / 2, and 1 is that for |r|
            (iteratively reweighted); with the L_k above and a mean over channels, the default of 0.5 acts as 1/6.
            `balanced` only.
        max_step: no entry of delta exceeds this many learning rates, or Adam's own entry where that is longer: coupling
            may pass motion on to a parameter whose own gradient is near zero, and the linear model that wants it
            does not hold that far. 1 is the length of Adam's step for gradients that always agree; 0 turns the bound
            off. `balanced` only, as the printed equation has no learning rates.
    """

    learning_rates: LearningRates = field(default_factory=LearningRates)
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-20
    units: Literal["balanced", "paper"] = "balanced"
    rows: Literal["views", "summed"] = "views"
    solver: Literal["cholesky", "low_rank"] = "low_rank"
    curvature: float = 0.5
    max_step: float = 1.0
    moments: GaussianMoments = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_moments_config(self.beta1, self.beta2, self.eps)
        choices = {"units": ("balanced", "paper"), "rows": ("views", "summed"), "solver": tuple(_SOLVERS)}
        for name, allowed in choices.items():
            require(getattr(self, name) in allowed, name, getattr(self, name), f"one of {', '.join(allowed)}")
        require_not_negative(self, "curvature", "max_step")

    def setup(self, gaussians: Gaussians) -> None:
        self.moments = GaussianMoments.zeros(gaussians)

    @property
    def skipped(self) -> Tensor:
        """[] int64 on the device: updates left out because of a non-finite gradient."""
        return self.moments.skipped

    def rule(self, step: Step) -> UpdateRule:
        """The rule of this iteration's step."""
        lm = MomentLMParams(self.units, self.rows, self.solver, self.curvature, self.max_step)
        return UpdateRule(self.learning_rates.at(step), self.beta1, self.beta2, self.eps, lm)

    @torch.no_grad()
    def step(self, gaussians: Gaussians, gradients: ScreenGradients, step: Step) -> None:
        rule, moments = self.rule(step), self.moments
        if take_fused_step(gaussians, gradients, moments, rule):
            return
        parameter_gradients = gradients.parameter_gradients(rows=self.rows == "views")
        index = updatable(parameter_gradients, moments)
        moments.steps[index] += 1
        steps = moments.steps[index]
        rows = packed_rows(parameter_gradients, index)  # [K, n, 14]
        losses = parameter_gradients.view_losses[:, index]  # [K, n]
        gradient = rows.sum(dim=0)
        terms = advance(moments.exp_avg, moments.exp_avg_sq, gradient, index, steps, rule)
        if self.units == "balanced":
            delta = balanced_delta(rows, losses, terms, rule)
        else:
            delta = paper_delta(rows, moments.exp_avg[index], moments.exp_avg_sq[index], rule)
        add_packed(gaussians, index, delta)
        step_shN(gaussians, parameter_gradients.shN, moments, index, steps, rule)

    def apply(self, update: RowUpdate) -> None:
        self.moments.apply(update)

    def state_dict(self) -> dict[str, Any]:
        return self.moments.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.moments.load_state_dict(state)


def balanced_delta(rows: Tensor, losses: Tensor, terms: AdamTerms, rule: UpdateRule) -> Tensor:
    """[n, 14] change of the parameters by the unit-consistent form.

    Args:
        rows: [K, n, 14] gradients of each view.
        losses: [K, n] the Gaussian's share of the loss in each view. A row whose share is zero or not finite says
            nothing of curvature and is left out.
        terms: of the bias-corrected moments, [n, 14].
    """
    rates = rule.packed_rates(rows)
    adam = terms.delta(rates)
    has_share = (losses > 0) & torch.isfinite(losses)
    largest = torch.finfo(rows.dtype).max
    weights = torch.where(has_share, (rule.lm.curvature / losses).clamp(max=largest), 0.0).to(rows.dtype)
    # A rate of zero holds its parameter: no coupling may move it, so it gets the damping of the largest float's root.
    damping = terms.denominator / rates.clamp(min=torch.finfo(rows.dtype).tiny ** 0.5)
    delta = torch.cat([_solve(rows, weights, damping, terms.mean, block, rule) for block in (GEOMETRY, APPEARANCE)], -1)
    if rule.lm.max_step > 0:
        bound = torch.maximum(rule.lm.max_step * rates, adam.abs())
        delta = torch.maximum(torch.minimum(delta, bound), -bound)
    # Without rows the solution is Adam's step; taking that one as it is makes them equal to the last bit.
    has_rows = torch.stack([_any_row(rows, weights, block) for block in (GEOMETRY, APPEARANCE)], dim=-1)  # [n, 2]
    sizes = torch.tensor([10, 4], device=rows.device)
    takes_solution = torch.repeat_interleave(has_rows, sizes, dim=-1, output_size=14) & (rates > 0)
    return torch.where(takes_solution, delta, adam)


def paper_delta(rows: Tensor, mean: Tensor, square: Tensor, rule: UpdateRule) -> Tensor:
    """[n, 14] change of the parameters by the printed equation.

    Args:
        rows: [K, n, 14] gradients of each view, the rows of J.
        mean, square: [n, 14] the moments m and v, without bias correction, as the equation has them.
    """
    weights = torch.ones_like(rows[..., 0])
    damping = torch.sqrt(square) + rule.eps
    return torch.cat([_solve(rows, weights, damping, mean, block, rule) for block in (GEOMETRY, APPEARANCE)], -1)


def _solve(rows: Tensor, weights: Tensor, damping: Tensor, mean: Tensor, block: slice, rule: UpdateRule) -> Tensor:
    solver = _SOLVERS[rule.lm.solver]
    return -solver(rows[..., block], weights, damping[:, block], mean[:, block])


def _any_row(rows: Tensor, weights: Tensor, block: slice) -> Tensor:
    """[n] bool: some view has a row for this block."""
    return ((rows[..., block] != 0).any(dim=-1) & (weights > 0)).any(dim=0)
