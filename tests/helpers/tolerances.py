"""How far results may be off, by the dtype they are computed in. Every bound of tests/stability comes from here; the
measured errors are in docs/numerics.md."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Tolerance:
    """Bounds of one dtype against float64.

    Args:
        pixel: colour of a sample, over the largest colour (at least 1).
        needle_pixel: the same where splats are a million times as long as thick, or images thousands of pixels wide.
        gradient: of a parameter, as a tensor: L2 of the difference over L2.
        needle_gradient: the same for needles, whose thickness has next to no gradient.
        step: of an optimizer's step, over the learning rate.
        solution: of a small system whose scaled rows are 30 long, over the length of Adam's step.
    """

    pixel: float
    needle_pixel: float
    gradient: float
    needle_gradient: float
    step: float
    solution: float


TOLERANCES = {
    torch.float32: Tolerance(
        pixel=5e-6, needle_pixel=2e-4, gradient=5e-5, needle_gradient=5e-3, step=1e-6, solution=2e-3
    ),
    torch.float64: Tolerance(
        pixel=1e-12, needle_pixel=1e-10, gradient=1e-10, needle_gradient=1e-8, step=1e-14, solution=1e-10
    ),
}

PSNR_BOUND = 0.1
"""dB between runs on one capture in other coordinates."""
