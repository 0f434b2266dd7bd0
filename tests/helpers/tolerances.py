"""How far results may be off, by the dtype they are computed in. Every bound of tests/stability comes from here; the
measured errors are in docs/numerics.md."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Tolerance:
    """Bounds of one dtype against float64. Needles are a million times as long as thick; images thousands of pixels
    wide count as such."""

    pixel: float  # colour of a sample, over the largest colour (at least 1)
    needle_pixel: float
    gradient: float  # of a parameter, as a tensor: L2 of the difference over L2
    needle_gradient: float  # a needle's thickness has next to no gradient


TOLERANCES = {torch.float32: Tolerance(pixel=5e-6, needle_pixel=2e-4, gradient=5e-5, needle_gradient=5e-3)}

PSNR_BOUND = 0.1
"""dB between runs on one capture in other coordinates."""

STRUCTURE_BOUND = 1e-3
"""Tolerance of a tile's gradient by l1 and NCC in float32, L2 of the difference over L2."""


@dataclass(frozen=True)
class StatisticsTolerance:
    """Bounds of density control's sums in float32 (`helpers.statistics_errors.StatisticsErrors`)."""

    total: float  # of the vector of a sum over all Gaussians, L2 of the difference over L2
    median_square: float  # relative, of single sums of squares
    worst_square: float
    exchanged: float  # share of those that a turnover of 5 % takes in the place of others


STATISTICS = StatisticsTolerance(total=1e-5, median_square=1e-4, worst_square=2e-2, exchanged=0.02)
STIFF_STATISTICS = StatisticsTolerance(total=2e-2, median_square=1e-3, worst_square=0.5, exchanged=0.05)
"""Tolerance for needles, and where squares leave float32's range."""

GPU_STATISTICS = StatisticsTolerance(total=2e-3, median_square=1e-3, worst_square=1.0, exchanged=0.05)
GPU_STIFF_STATISTICS = StatisticsTolerance(total=5e-2, median_square=1e-2, worst_square=10.0, exchanged=0.1)
"""Tolerance of the kernels, which use the hardware's exponential: twice their bound of a gradient. Stiff besides:
splats whose alpha is on the threshold in every pixel, where single pixels fall to the other side."""
