"""The mean of the parameters over the last iterations of a run, which becomes the model.

With a learning rate that does not fall to zero, parameters go on wandering about the place that they have come to, each
iteration after other views and pixels. Their mean over some iterations is nearer to that place (Polyak and Juditsky,
1992; for networks Izmailov et al., 2018). Not in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

AVERAGE_EVERY = 4
"""Iterations from one that counts to the next: one after another are too alike to tell more."""


class ParameterMean:
    """The mean of tensors, by name, over the `count` iterations that were added since it began: `tensors`, without rows
    where there is none. For any trainer: ask `due` after each iteration, `add` where it is; `restart` where rows are of
    other Gaussians; and `overwrite` at the end.

    Args:
        share: of a run's iterations, at its end, that count.
        tensors: of the present iteration, for their layout alone. A mapping, such as gsplat's splats.
    """

    def __init__(self, share: float, tensors: Mapping[str, Tensor]) -> None:
        self.share, self.count = share, 0
        self.tensors = {name: value.detach()[:0].clone() for name, value in tensors.items()}

    def due(self, iteration: int, total: int) -> bool:
        """Whether the parameters after this number of iterations, of `total`, count. Where none are to count yet, it
        begins anew: a time budget has made the run longer."""
        if iteration < (1.0 - self.share) * total:
            self.restart()
            return False
        return iteration % AVERAGE_EVERY == 0 or iteration == total

    def add(self, tensors: Mapping[str, Tensor]) -> None:
        """Add the tensors of one more iteration, which are copied. Where there are more or fewer rows, begin anew."""
        if any(mean.shape != tensors[name].shape for name, mean in self.tensors.items()):
            self.restart()
        if self.count == 0:
            self.tensors = {name: value.detach().clone() for name, value in tensors.items()}
        else:
            for name, mean in self.tensors.items():
                mean.lerp_(tensors[name].detach(), 1.0 / (self.count + 1))
        self.count += 1

    def restart(self) -> None:
        """Begin anew: from here on the parameters are of other Gaussians."""
        if self.count:
            self.count = 0
            self.tensors = {name: mean[:0].clone() for name, mean in self.tensors.items()}

    @torch.no_grad()
    def overwrite(self, tensors: Mapping[str, Tensor]) -> None:
        """Write the mean, if there is one, into the tensors, and begin anew. Raises torch's `RuntimeError` where they
        have other rows."""
        if self.count:
            for name, mean in self.tensors.items():
                tensors[name].copy_(mean)
        self.restart()

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "tensors": dict(self.tensors)}

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Load a saved state onto a device."""
        self.count = state["count"]
        self.tensors = {name: value.to(device) for name, value in state["tensors"].items()}
