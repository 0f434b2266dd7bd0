"""Exposure and white balance of each training photo: an affine map of the rendered colour, its gradients and its Adam.

A photo's colour is taken to be ``c + A c + b`` of the model's colour c, with A [3, 3] and b [3] for each photo, as
Niedermayr et al. (2024) and 3DGS's `train_test_exp` have it. Two rules keep the model's own colours where they are:
the objective has a term for the distance from the identity, and the mean of A and b over all photos is zero (the
gauge: else the model could darken and all exposures brighten).

Nothing here waits for a GPU. `engine.cuda.training` has the twins of `expose`, `exposure_gradients` and
`step_exposures`: in torch, the three take as long on a GPU as two other iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.device import on_device
from turbogs_plugin.engine.moments import check_state
from turbogs_plugin.types import PixelSamples, Step

FIRST_RATE, LAST_RATE = 3e-3, 3e-4
"""Adam's rates at the start and the end of a run, a third of 3DGS's for exposures. Not yet measured."""
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
PULL = 0.01
"""Weight of ``mean over the views of a batch of (|A|^2 + |b|^2) / 2`` in the objective. A photo at half the exposure
has A = -0.5, which the term pulls back with .005, and a photo's error in colour pulls with up to a third of the mean
colour. Not yet measured."""

SUM_GRID = 2.0**40
"""Products that are added up to a photo's gradient are multiples of 1 / this: their sums, below 2^13, are exact in any
order, so several processes that compute them get equal ones."""


@dataclass
class Exposures:
    """The exposures of V training photos.

    Args:
        offsets: [V, 3, 4] float32, ``A | b``: the map less the identity. Zeros map every colour to itself, to the bit.
        exp_avg, exp_avg_sq: [V, 3, 4] float32, Adam's moments.
        steps: [V] int32, updates of each photo, for the bias correction.
    """

    offsets: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    steps: Tensor

    @classmethod
    def identity(cls, views: int, device: torch.device | str) -> Exposures:
        """Exposures of photos that were never updated."""
        offsets, exp_avg, exp_avg_sq = torch.zeros(3, views, 3, 4, device=device).unbind()
        return cls(offsets, exp_avg, exp_avg_sq, torch.zeros(views, dtype=torch.int32, device=device))

    def state_dict(self) -> dict[str, Any]:
        return dict(vars(self))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved state. Raises `InputError` if it is of another number of photos."""
        check_state(state, self.state_dict(), owner="exposures")
        for name, present in self.state_dict().items():
            present.copy_(state[name])


def exposure_rate(step: Step) -> float:
    """Adam's rate, which falls from `FIRST_RATE` to `LAST_RATE` exponentially."""
    share = min(1.0, step.iteration / max(1, step.total))
    return FIRST_RATE * (LAST_RATE / FIRST_RATE) ** share


def expose(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
    """[P, 3] float32: ``c + A c + b`` of the rendered colours [P, 3], each with the exposure of its slot's photo."""
    colors = colors.detach().float()
    maps = _of_slots(exposures, samples)
    return colors + ((maps[:, :, :3] * colors[:, None, :]).sum(dim=2) + maps[:, :, 3])


def exposure_gradients(
    exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples
) -> tuple[Tensor, Tensor]:
    """Gradients through `expose` of colours [P, 3], from d loss / d the exposed colours [P, 3].

    Returns:
        [P, 3] float32, d loss / d colours: ``g + A^T g``; and [K, 3, 4] float64, d loss / d (A | b) of each view of the
        batch, ``sum over its samples of g (c | 1)^T``, in which a colour that is not finite has no part.
    """
    colors, gradients = colors.detach().float(), gradients.float()
    maps = _of_slots(exposures, samples)
    of_colors = gradients + (maps[:, :, :3] * gradients[:, :, None]).sum(dim=1)
    finite = colors.isfinite().all(dim=1, keepdim=True)
    extended = torch.nn.functional.pad(torch.where(finite, colors, 0.0), (0, 1), value=1.0).double()  # [P, 4]
    products = torch.where(finite, gradients, 0.0).double()[:, :, None] * extended[:, None, :]
    products = products.mul_(SUM_GRID).round_().div_(SUM_GRID)
    # Tile by tile first: on a GPU, additions to one number wait for each other.
    tile_sums = products.new_zeros(len(samples.tile_ids), 3, 4).index_add_(0, samples.tile_of_slot(), products)
    sums = products.new_zeros(len(samples.view_ids), 3, 4)
    return of_colors, sums.index_add_(0, samples.view_of_tile(), tile_sums)


def step_exposures(
    exposures: Exposures, sums: Tensor, view_ids: tuple[int, ...], rate: float, overflow: Tensor | None = None
) -> None:
    """One step of Adam for the K photos of a batch, in place; then the mean over all V is made zero again.

    A photo whose gradient is not finite keeps its map and moments.

    Args:
        sums: [K, 3, 4] float64, d loss / d (A | b), to which the pull to the identity is added here.
        view_ids: K different training photos.
        rate: Adam's.
        overflow: [1] int32 on the device, or None; if it is not 0, nothing changes (see `Engine.overflow`).
    """
    rows = on_device(view_ids, sums.device)
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
    rows = on_device(samples.view_ids, exposures.offsets.device)
    return exposures.offsets[rows[samples.view_of_slot()]]
