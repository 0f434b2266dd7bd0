"""One step of the parameters in torch: the definition of `UpdateRule` (paper section 3.9 and appendix).

A step is a function of (parameters, gradients, `GaussianMoments`, `UpdateRule`). A Gaussian that no sample touched
keeps its parameters, moments and step count. So does one with a gradient that is not finite; these are counted.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ParameterRow
from turbogs_plugin.engine.moments import COLUMNS, GaussianMoments
from turbogs_plugin.engine.reference.lm_solvers import solve_low_rank
from turbogs_plugin.engine.rules import MomentLMParams, ParameterRates, UpdateRule
from turbogs_plugin.types import GaussianGradients, Gaussians

BLOCKS = (
    slice(ParameterRow.MEANS.start, ParameterRow.QUATS.stop),
    slice(ParameterRow.SH0.start, ParameterRow.OPACITIES.stop),
)
"""The two blocks of a packed row that moment-damped LM solves: geometry and appearance."""

GRADIENT_LIMIT, SUM_LIMIT = 1e17, 1.8e19
"""Gradients of a view, and their sums, are cut here, so that the square of a sum stays finite in float32 (up to
3.4e38). Sums over `layout.MAX_VIEWS` views, a kernel's most, never reach the second."""


@torch.no_grad()
def apply_update(
    rule: UpdateRule, gaussians: Gaussians, gradients: GaussianGradients, moments: GaussianMoments
) -> None:
    """Make one step of `rule`: changes `gaussians` and `moments` in place.

    The higher bands make Adam's step under every rule: they are in no block (appendix, second half of the LM equation).

    Args:
        gradients: of each view, or their sum; this function sums them where the rule needs that.
    """
    finite = finite_gradients(gradients)
    moments.skipped += (gradients.touched & ~finite).sum()
    index = torch.nonzero(gradients.touched & finite).squeeze(-1)  # [n] Gaussians to update
    moments.steps[index] += 1
    steps = moments.steps[index]
    columns = [getattr(gradients, name)[:, index].unsqueeze(-1).flatten(2) for name in COLUMNS]
    rows = clipped(torch.cat(columns, dim=-1))  # [K, n, 14]
    losses = gradients.view_losses[:, index]  # [K, n]
    gradient = rows.sum(dim=0).clamp(-SUM_LIMIT, SUM_LIMIT)
    terms = advance(moments.exp_avg, moments.exp_avg_sq, gradient, index, steps, rule)
    if rule.lm is None:
        delta = adam_step(packed_rates(rule.rates, gradient), *terms)
    else:
        if not rule.per_view:
            rows, losses = gradient[None], losses.sum(dim=0, keepdim=True)
        if rule.lm.units == "balanced":
            delta = balanced_delta(rows, losses, *terms, rule.rates, rule.lm)
        else:
            # The printed equation: the g_k are the rows of J, and m and v have no bias correction.
            damping = torch.sqrt(moments.exp_avg_sq[index]) + rule.eps
            delta = _solve(rows, torch.ones_like(losses), damping, moments.exp_avg[index])
    gradient = clipped(gradients.shN[index].flatten(1))
    terms = advance(moments.exp_avg_shN, moments.exp_avg_sq_shN, gradient, index, steps, rule)
    changes = {name: delta[:, place] for name, place in COLUMNS.items()}
    for name, change in {**changes, "shN": adam_step(rule.rates.shN, *terms)}.items():
        value = getattr(gaussians, name)
        value.index_add_(0, index, change.reshape(len(index), *value.shape[1:]))


def packed_rates(rates: ParameterRates, like: Tensor) -> Tensor:
    """[14] the rates in the order of a packed row, in the dtype and on the device of `like`."""
    values = [getattr(rates, name) for name, s in COLUMNS.items() for _ in range(s.stop - s.start)]
    return torch.tensor(values, dtype=like.dtype, device=like.device)


def clipped(gradient: Tensor) -> Tensor:
    """The gradient cut at `GRADIENT_LIMIT`."""
    return gradient.clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)


def finite_gradients(gradients: GaussianGradients) -> Tensor:
    """[N] bool: every gradient of the Gaussian is finite, in every view."""
    finite = torch.isfinite(gradients.shN.flatten(1)).all(dim=-1)
    for name in COLUMNS:
        value = getattr(gradients, name)
        finite &= torch.isfinite(value).unsqueeze(-1).flatten(2).all(dim=-1).all(dim=0)
    return finite


def advance(
    exp_avg: Tensor, exp_avg_sq: Tensor, gradient: Tensor, index: Tensor, steps: Tensor, rule: UpdateRule
) -> tuple[Tensor, Tensor]:
    """Advance the moments of the Gaussians `index` [n] by their gradients [n, D]. `steps`: [n], this one included.

    Returns:
        Bias-corrected m; sqrt(v) + eps, v bias-corrected: [n, D] each.

    1 - beta is computed in double, and the bias correction 1 - beta^t as -expm1(t log beta): in float32 either
    difference would have a relative error of 5e-5 for beta = 0.999.
    """
    mean = torch.lerp(exp_avg[index], gradient, 1 - rule.beta1)
    square = torch.lerp(exp_avg_sq[index], gradient * gradient, 1 - rule.beta2)
    exp_avg[index], exp_avg_sq[index] = mean, square
    count = steps.to(gradient.dtype).unsqueeze(-1)  # [n, 1]
    mean_correction = -torch.expm1(count * math.log(rule.beta1)) if rule.beta1 > 0 else 1.0
    square_correction = -torch.expm1(count * math.log(rule.beta2)) if rule.beta2 > 0 else 1.0
    return mean / mean_correction, torch.sqrt(square / square_correction) + rule.eps


def adam_step(rates: Tensor | float, mean: Tensor, denominator: Tensor) -> Tensor:
    """[n, D] the change of the parameters by Adam, from the results of `advance`."""
    return -(rates * (mean / denominator))


def balanced_delta(
    rows: Tensor, losses: Tensor, mean: Tensor, denominator: Tensor, parameter_rates: ParameterRates, lm: MomentLMParams
) -> Tensor:
    """[n, 14] change of the parameters by the unit-consistent form.

    Args:
        rows: [K, n, 14] gradients of each view.
        losses: [K, n] the Gaussian's share of the loss in each view. A row whose share is zero or not finite is left
            out, as it says nothing about curvature.
        mean, denominator: [n, 14], from `advance`.
    """
    rates = packed_rates(parameter_rates, rows)
    adam = adam_step(rates, mean, denominator)
    has_share = (losses > 0) & torch.isfinite(losses)
    largest = torch.finfo(rows.dtype).max
    weights = torch.where(has_share, (lm.curvature / losses).clamp(max=largest), 0.0).to(rows.dtype)
    # A rate of zero fixes its parameter, even against coupling: its damping divides by the root of the smallest float.
    damping = denominator / rates.clamp(min=torch.finfo(rows.dtype).tiny ** 0.5)
    delta = _solve(rows, weights, damping, mean)
    if lm.max_step > 0:
        bound = torch.maximum(lm.max_step * rates, adam.abs())
        delta = torch.maximum(torch.minimum(delta, bound), -bound)
    # Without rows the solution is Adam's step; taking Adam's makes them equal to the last bit.
    takes_solution = torch.zeros_like(delta, dtype=torch.bool)
    for block in BLOCKS:
        has_row = (rows[..., block] != 0).any(dim=-1) & (weights > 0)  # [K, n]
        takes_solution[:, block] = has_row.any(dim=0)[:, None]
    return torch.where(takes_solution & (rates > 0), delta, adam)


def _solve(rows: Tensor, weights: Tensor, damping: Tensor, mean: Tensor) -> Tensor:
    """[n, 14] minus the solution of the damped systems, the 10x10 block of geometry and the 4x4 one of appearance."""
    return -torch.cat([solve_low_rank(rows[..., b], weights, damping[:, b], mean[:, b]) for b in BLOCKS], dim=-1)
