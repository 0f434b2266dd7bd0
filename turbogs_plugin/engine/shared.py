"""What both engines do alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.types import LossOutput, PixelSamples, Step


def draw_arguments(
    rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step
) -> dict[str, Any]:
    """What `engine.reference.draws.draw_pixels` and its CUDA twin take, once the maps of these views are there."""
    maps.fetch(view_ids)
    views = np.asarray(view_ids, dtype=np.int64)
    return {
        "errors": maps.errors,
        "stamps": maps.stamps,
        "now": step.iteration - maps.stamp_base,
        "starts": maps.offsets[views],
        "sizes": maps.sizes[views],
        "view_ids": view_ids,
        "rate": rate,
        "rule": rule,
        "seed": step.seed,
        "iteration": step.iteration,
    }


def learn(
    maps: ErrorMaps,
    samples: PixelSamples,
    colors: Tensor,
    output: LossOutput,
    step: Step,
    nonfinite_losses: Tensor | None,
    overflow: Tensor | None = None,
) -> None:
    """`Engine.learn`.

    Args:
        overflow: [1] int32 on the device; where it is not 0, nothing was drawn: the maps stay as they are, and the loss
            does not count as lost. It is never read on the host.
    """
    drawn, nonfinite = torch.isfinite(colors).all(dim=1), ~output.loss.isfinite()
    if overflow is not None:
        drawn, nonfinite = drawn & (overflow == 0), nonfinite & (overflow[0] == 0)
    maps.update(samples, torch.where(drawn, output.pixel_errors, torch.nan), step)
    if nonfinite_losses is not None:
        nonfinite_losses += nonfinite
