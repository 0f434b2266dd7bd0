"""What both engines do alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.layout import MAX_SH_DEGREE
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Gaussians, LossOutput, PixelSamples, Step


def used_degree(gaussians: Gaussians, sh_degree: int | None) -> int:
    """The degree of spherical harmonics to evaluate; all that the model holds where None.

    Raises:
        InputError: the model holds more than any engine evaluates, or not what is asked for.
    """
    held = gaussians.sh_degree
    if held > MAX_SH_DEGREE:
        raise InputError(
            f"these Gaussians hold spherical harmonics of degree {held}: the largest that is rendered is "
            f"{MAX_SH_DEGREE}, so leave the coefficients above it out"
        )
    if sh_degree is not None and not 0 <= sh_degree <= held:
        raise InputError(f"sh_degree is {sh_degree}, but these Gaussians hold degrees 0 to {held}")
    return held if sh_degree is None else sh_degree


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
