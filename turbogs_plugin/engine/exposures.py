"""Exposure and white balance of each training photo: an affine map of the rendered colour, and its Adam state.

A photo's colour is taken to be ``c + A c + b`` of the model's colour c, with A [3, 3] and b [3] for each photo, as
Niedermayr et al. (2024) and 3DGS's `train_test_exp` have it. Two rules keep the model's own colours where they are:
the objective has a term for the distance from the identity, and the mean of A and b over all photos is zero (the
gauge: else the model could darken and all exposures brighten).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.moments import check_state
from turbogs_plugin.types import Step

FIRST_RATE = 3e-3
LAST_RATE = 3e-4
"""Adam's rates at the start and the end of a run, a third of 3DGS's for exposures. Not yet measured."""
BETA1 = 0.9
BETA2 = 0.999
EPSILON = 1e-15
PULL = 0.01
"""Weight of ``mean over the views of a batch of (|A|^2 + |b|^2) / 2`` in the objective. A photo at half the exposure
has A = -0.5, which the term pulls back with .005, and a photo's error in colour pulls with up to a third of the mean
colour. Not yet measured."""


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

    @classmethod
    def of_gains(cls, gains: Tensor, device: torch.device | str) -> Exposures:
        """Exposures of photos that were never updated, but are known to differ by gains.

        Args:
            gains: [V, 3] of the channels, in stops: factors of 2.
        """
        exposures, factors = cls.identity(len(gains), device), 2.0 ** gains.double()  # [V, 3]
        exposures.offsets[:, range(3), range(3)] = (factors / factors.mean(dim=0) - 1.0).to(exposures.offsets)
        return exposures

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
