"""Exposures in torch: the map of rendered colours, its gradients, and a step of Adam. The definition."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.exposures import BETA1, BETA2, EPSILON, PULL, Exposures
from turbogs_plugin.types import PixelSamples


def expose(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
    """[P, 3] float32: ``c + A c + b`` of the rendered colours [P, 3], each with the exposure of its slot's photo."""
    colors = colors.detach().float()
    maps = _of_slots(exposures, samples)
    return colors + ((maps[:, :, :3] * colors[:, None, :]).sum(dim=2) + maps[:, :, 3])


def exposure_gradients(
    exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples
) -> tuple[Tensor, Tensor]:
    """Gradients through `expose`.

    A sample whose rendered colour is not finite has no part in the second.

    Args:
        colors: [P, 3], as given to `expose`.
        gradients: [P, 3], d loss / d the exposed colours.

    Returns:
        [P, 3] float32, d loss / d colours: ``g + A^T g``; and [K, 3, 4] float64, d loss / d (A | b) of each view of the
        batch, ``sum over its samples of g (c | 1)^T``.
    """
    colors, gradients = colors.detach().float(), gradients.float()
    maps = _of_slots(exposures, samples)
    of_colors = gradients + (maps[:, :, :3] * gradients[:, :, None]).sum(dim=1)
    finite = colors.isfinite().all(dim=1, keepdim=True)
    extended = torch.nn.functional.pad(torch.where(finite, colors, 0.0), (0, 1), value=1.0).double()  # [P, 4]
    products = torch.where(finite, gradients, 0.0).double()[:, :, None] * extended[:, None, :]
    sums = products.new_zeros(len(samples.view_ids), 3, 4)
    return of_colors, sums.index_add_(0, samples.view_of_slot(), products)


def step_exposures(
    exposures: Exposures, sums: Tensor, view_ids: tuple[int, ...], rate: float, overflow: Tensor | None = None
) -> None:
    """One step of Adam for the K photos of a batch, in place; then the mean over all V is made zero again.

    A photo whose gradient is not finite keeps its map and moments.

    Args:
        sums: [K, 3, 4] float64, d loss / d (A | b), to which the pull to the identity is added here.
        view_ids: K different training photos.
        rate: Adam's.
        overflow: [1] int32 on the device, or None; if it is not 0, nothing changes.
    """
    rows = torch.tensor(view_ids, device=sums.device)
    offsets = exposures.offsets[rows]
    gradients = sums.float() + PULL / len(view_ids) * offsets
    usable = gradients.isfinite().flatten(1).all(dim=1)  # [K]
    if overflow is not None:
        usable = usable & (overflow == 0)
    gradients = torch.where(usable[:, None, None], gradients, 0.0)
    first = torch.lerp(exposures.exp_avg[rows], gradients, 1.0 - BETA1)
    second = torch.lerp(exposures.exp_avg_sq[rows], gradients.square(), 1.0 - BETA2)
    steps = exposures.steps[rows] + 1
    corrections = (1.0 - base ** steps.double() for base in (BETA1, BETA2))
    correction1, correction2 = (correction.float()[:, None, None] for correction in corrections)
    moved = offsets - rate * (first / correction1) / ((second / correction2).sqrt() + EPSILON)
    for name, value in (("offsets", moved), ("exp_avg", first), ("exp_avg_sq", second), ("steps", steps)):
        present = getattr(exposures, name)
        keep = usable.view(-1, *[1] * (value.dim() - 1))
        present[rows] = torch.where(keep, value, present[rows])
    exposures.offsets -= torch.where(usable.any(), exposures.offsets.mean(dim=0), 0.0)


def _of_slots(exposures: Exposures, samples: PixelSamples) -> Tensor:
    """[P, 3, 4]: the offsets of each slot's photo."""
    rows = torch.tensor(samples.view_ids, device=exposures.offsets.device)
    return exposures.offsets[rows[samples.view_of_slot()]]
