"""By what Gaussians are put in order where an event can take only some: who grows first, who goes first."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import GaussianStats, Step

GrowthOrder = Literal["difficulty", "squares"]
PruneOrder = Literal["difficulty", "weight", "squares"]

TINY = 1e-30
"""The least sum of squares that a draw tells from 0."""


def growth_priority(stats: GaussianStats, score: Tensor, how: GrowthOrder, step: Step) -> Tensor:
    """[N] keys: the larger, the sooner a Gaussian grows.

    By `difficulty` they are the scores. By `squares`, the largest k are a draw of k without replacement (Gumbel's
    trick), with chances in proportion to `GaussianStats.square_sums`. That sum stays large where some samples want a
    Gaussian more opaque and others less, where the gradient itself cancels. LiteGS scores by the variance of the same
    gradient. The noise is drawn on the host, so it is the same on every device.

    Args:
        stats: of the window.
        score: [N] difficulty.
        step: its seed and iteration are those of the draw.
    """
    if how == "difficulty":
        return score
    squares = torch.where(torch.isfinite(stats.square_sums), stats.square_sums, 0.0)
    generator = np.random.Generator(np.random.Philox(np.random.SeedSequence([step.seed, step.iteration, 1])))
    noise = torch.from_numpy(generator.gumbel(size=len(squares))).to(squares)
    return squares.clamp(min=TINY).log() + noise


def contribution(stats: GaussianStats, score: Tensor, seen: Tensor, how: PruneOrder) -> tuple[Tensor, Tensor]:
    """([N] the smaller, the sooner a Gaussian goes; [N] bool, for which that is known).

    By `difficulty` these are the score and the seen. By `weight`, the sum of blending weights, or `squares`, the sum of
    squares of the opacity gradient, all with a finite sum are known: what was not seen contributes nothing.

    Args:
        stats: of the window.
        score, seen: [N] difficulty, and bool.
    """
    if how == "difficulty":
        return score, seen
    value = stats.weight_sums if how == "weight" else stats.square_sums
    known = torch.isfinite(value)
    return torch.where(known, value, 0.0), known
