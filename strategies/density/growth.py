"""Growth of density control: which Gaussians grow by squares, and two Gaussians in the place of one.

The *squares* of a Gaussian, `GaussianStats.square_sums`, are the sum over the window's samples of (o * d loss / d o)^2,
o its opacity. The sum stays large where some samples want a Gaussian more opaque and others less, where the gradient
itself cancels: one Gaussian cannot serve both. The sum is near 0 where a Gaussian makes no difference. LiteGS scores
growth by the variance of the same gradient.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.reference.philox import PURPOSE_GROWTH, exponentials, random_words
from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.types import Gaussians, GaussianStats, Step

TINY = 1e-30
"""Least sum of squares that a draw tells from 0."""

SPLIT_SHRINK = 1.6
"""Divisor of the standard deviations at a split (3DGS)."""


def drawn_by_squares(stats: GaussianStats, step: Step) -> Tensor:
    """[N] keys, of which the largest k are a draw of k without replacement, with chances in proportion to squares.

    Gumbel's trick: a key is the logarithm of a weight plus noise, which is minus the logarithm of an exponential
    variate of the row. The variates are the same on every device. A sum that is not finite counts as 0.

    Args:
        stats: statistics of the window.
        step: its seed and iteration decide the draw.
    """
    squares, _ = squares_of(stats)
    rows = torch.arange(len(squares), device=squares.device)
    words = random_words(rows, 0, PURPOSE_GROWTH, step.seed, step.iteration)
    return squares.clamp(min=TINY).log() - exponentials(words[0]).log()


def squares_of(stats: GaussianStats) -> tuple[Tensor, Tensor]:
    """([N] sums of squares, 0 where not finite; [N] bool, which are finite). A Gaussian that was not seen has 0."""
    return stats.square_sums.nan_to_num(0.0, 0.0, 0.0), torch.isfinite(stats.square_sums)


def split_in_two(
    gaussians: Gaussians, rows: Tensor, how: Literal["sample", "long_axis"], step: Step
) -> tuple[Tensor, Tensor]:
    """Means and scales of the halves of some Gaussians.

    Args:
        gaussians: the model.
        rows: [n] int64, which of them.
        how: `split` of `ErrorDrivenDensity`.
        step: its seed and iteration decide the draws.

    Returns:
        [2 n, 3] means and [2 n, 3] log scales: the first halves of all, then the second ones.
    """
    means, scales = gaussians.means[rows], gaussians.scales[rows]
    rotations = rotation_matrices(gaussians.quats[rows])  # [n, 3, 3]
    if how == "sample":
        generator = np.random.Generator(np.random.Philox(np.random.SeedSequence([step.seed, step.iteration])))
        # Drawn on the host: the same numbers on every device.
        draws = torch.from_numpy(generator.standard_normal((2, len(rows), 3))).to(means)
        offsets = torch.einsum("nij,bnj->bni", rotations, scales.exp() * draws)
        shrink = torch.full_like(scales, math.log(SPLIT_SHRINK))
    else:
        axis = torch.nn.functional.one_hot(scales.argmax(dim=-1), 3).to(scales)  # [n, 3]
        # A pair at +-a of deviation b has variance a^2 + b^2; b = sigma / 1.6, so a^2 = sigma^2 (1 - 1 / 1.6^2).
        distance = math.sqrt(1 - SPLIT_SHRINK**-2)
        offset = torch.einsum("nij,nj->ni", rotations, scales.exp() * axis * distance)
        offsets = torch.stack([offset, -offset])
        shrink = axis * math.log(SPLIT_SHRINK)
    return (means + offsets).reshape(-1, 3), (scales - shrink).repeat(2, 1)
