"""Density control by squares: which Gaussians grow, and which are removed.

The *squares* of a Gaussian, `GaussianStats.square_sums`, are the sum over the window's samples of (o * d loss / d o)^2,
o its opacity. The sum stays large where some samples want a Gaussian more opaque and others less, where the gradient
itself cancels: one Gaussian cannot serve both. It is near 0 where a Gaussian makes no difference. LiteGS
scores growth by the variance of the same gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.reference.philox import PURPOSE_GROWTH, exponentials, random_words
from turbogs_plugin.types import GaussianStats, Step

TINY = 1e-30
"""The least sum of squares that a draw tells from 0."""


def drawn_by_squares(stats: GaussianStats, step: Step) -> Tensor:
    """[N] keys, of which the largest k are a draw of k without replacement, with chances in proportion to squares.

    That is Gumbel's trick: the logarithm of a weight plus noise, which is minus the logarithm of an exponential variate
    of the row. The variates are the same on every device. A sum that is not finite counts as 0.

    Args:
        stats: of the window.
        step: its seed and iteration are those of the draw.
    """
    squares = _finite_squares(stats)
    rows = torch.arange(len(squares), device=squares.device)
    words = random_words(rows, 0, PURPOSE_GROWTH, step.seed, step.iteration)
    return squares.clamp(min=TINY).log() - exponentials(words[0]).log()


def squares_of(stats: GaussianStats) -> tuple[Tensor, Tensor]:
    """([N] sums of squares, 0 where not finite; [N] bool, which are finite). What was not seen has 0."""
    return _finite_squares(stats), torch.isfinite(stats.square_sums)


def _finite_squares(stats: GaussianStats) -> Tensor:
    """[N] sums of squares, 0 where not finite."""
    return stats.square_sums.nan_to_num(0.0, 0.0, 0.0)
