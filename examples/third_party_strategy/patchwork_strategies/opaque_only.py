"""A density controller: from time to time, what is transparent goes."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from turbogs_plugin.errors import require
from turbogs_plugin.strategies import DensityController, Gaussians, RowUpdate, Step


@dataclass
class OpaqueOnlyDensity(DensityController):
    """Nothing is added; every `every` iterations, Gaussians of less opacity than `least_opacity` are removed.

    It keeps nothing by Gaussian, so `update` is all that it needs.

    Args:
        every: iterations between two prunings.
        least_opacity: 0 .. 1.
    """

    every: int = 100
    least_opacity: float = 0.01

    def __post_init__(self) -> None:
        require(self.every >= 1, "every", self.every, "at least 1")
        require(0 <= self.least_opacity < 1, "least_opacity", self.least_opacity, "at least 0 and less than 1")

    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        if step.iteration == 0 or step.iteration % self.every != 0:
            return None
        kept = torch.nonzero(torch.sigmoid(gaussians.opacities) >= self.least_opacity).squeeze(-1)
        if len(kept) in (0, len(gaussians)):
            return None
        fresh = torch.zeros_like(kept, dtype=torch.bool)
        return RowUpdate(kept, fresh, {}, num_pruned=len(gaussians) - len(kept))
