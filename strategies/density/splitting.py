"""Splitting: two Gaussians in the place of one."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.types import Gaussians, Step

SPLIT_SHRINK = 1.6
"""A split divides standard deviations by this (3DGS)."""


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
