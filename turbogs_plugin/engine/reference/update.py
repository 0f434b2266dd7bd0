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
from turbogs_plugin.engine.rules import UpdateRule
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
    """Make one step of `rule`, by the gradients of each view or their sum: changes `gaussians` and `moments` in place.
    The higher bands make Adam's step under every rule: they are in no block (appendix, second half of the LM equation).
    """
    finite = finite_gradients(gradients)
    moments.skipped += (gradients.touched & ~finite).sum()
    index = torch.nonzero(gradients.touched & finite).squeeze(-1)  # [n] Gaussians to update
    moments.steps[index] += 1
    steps = moments.steps[index]
    columns = [getattr(gradients, name)[:, index].unsqueeze(-1).flatten(2) for name in COLUMNS]
    rows = clipped(torch.cat(columns, dim=-1))  # [K, n, 14]
    gradient = rows.sum(dim=0).clamp(-SUM_LIMIT, SUM_LIMIT)
    terms = advance(moments.exp_avg, moments.exp_avg_sq, gradient, index, steps, rule)
    rates = gradient.new_empty(ParameterRow.SIZE)
    for name, place in COLUMNS.items():
        rates[place] = getattr(rule.rates, name)
    if rule.kind == "adam":
        delta = adam_step(rates, *terms)
    else:
        # The printed equation: the g_k are the rows of J, and m and v have no bias correction.
        damping, mean = torch.sqrt(moments.exp_avg_sq[index]) + rule.eps, moments.exp_avg[index]
        solution = [solve_low_rank(rows[..., block], damping[:, block], mean[:, block]) for block in BLOCKS]
        delta = -torch.cat(solution, dim=-1)
        if rule.kind == "moment_lm":
            delta *= rates
    gradient = clipped(gradients.shN[index].flatten(1))
    terms = advance(moments.exp_avg_shN, moments.exp_avg_sq_shN, gradient, index, steps, rule)
    changes = {name: delta[:, place] for name, place in COLUMNS.items()}
    for name, change in {**changes, "shN": adam_step(rule.rates.shN, *terms)}.items():
        value = getattr(gaussians, name)
        value.index_add_(0, index, change.reshape(len(index), *value.shape[1:]))


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
