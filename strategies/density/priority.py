"""By what Gaussians are put in order where an event can take only some: who grows first, who goes first."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import GaussianStats, Step

GrowthOrder = Literal["difficulty", "gradient", "opposed", "squares", "error"]
PruneOrder = Literal["difficulty", "weight", "squares"]

TINY = 1e-30
"""The least priority that a draw tells from 0."""


def growth_priority(stats: GaussianStats, score: Tensor, how: GrowthOrder) -> Tensor:
    """[N], the larger the sooner: by the difficulty `score`, or by a statistic of the window.

    `gradient` is the mean absolute screen gradient, `opposed` what of it cancels in the signed one, `squares` the sum
    of (o * d loss / d o)^2 over samples (LiteGS scores by its variance), and `error` E / sqrt(W), between sum and mean.
    """
    views = stats.view_counts.clamp(min=1)
    if how == "gradient":
        value = stats.absgrad_sums / views
    elif how == "opposed":
        value = (stats.absgrad_sums - stats.grad_sums) / views
    elif how == "squares":
        value = stats.square_sums
    elif how == "error":
        value = stats.error_sums / stats.weight_sums.clamp(min=TINY).sqrt()
    else:
        return score
    return torch.where(torch.isfinite(value), value, 0.0)


def drawn_priority(priority: Tensor, step: Step) -> Tensor:
    """[N] keys whose largest k are a draw of k without replacement, with chances in proportion to `priority`.

    Gumbel's trick. The noise is drawn on the host: the same numbers on every device.
    """
    generator = np.random.Generator(np.random.Philox(np.random.SeedSequence([step.seed, step.iteration, 1])))
    noise = torch.from_numpy(generator.gumbel(size=len(priority))).to(priority)
    return priority.clamp(min=TINY).log() + noise


def contribution(stats: GaussianStats, score: Tensor, seen: Tensor, how: PruneOrder) -> tuple[Tensor, Tensor]:
    """([N] the smaller the sooner it goes, [N] bool which are known).

    By `weight`, the sum of blending weights, or by `squares`, all with finite sums are known: what was not seen
    contributes nothing.
    """
    if how == "difficulty":
        return score, seen
    value = stats.weight_sums if how == "weight" else stats.square_sums
    known = torch.isfinite(value)
    return torch.where(known, value, 0.0), known
