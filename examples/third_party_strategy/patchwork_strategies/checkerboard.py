"""A pixel sampler: the black fields of a checkerboard in one iteration, the white ones in the next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from turbogs_plugin.errors import require
from turbogs_plugin.strategies import DensePixelSampler, ErrorMaps, PixelSamples, Step


@dataclass
class CheckerboardPixelSampler:
    """Every other field of `field_size` x `field_size` pixels, whatever the rate; the others in the next iteration.

    Args:
        field_size: in pixels.
    """

    field_size: int = 1

    def __post_init__(self) -> None:
        require(self.field_size >= 1, "field_size", self.field_size, "at least 1")

    def sample(self, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        """Samples whose slots of the other colour are empty."""
        dense = DensePixelSampler().sample(maps, view_ids, 1.0, step)
        x, y = (dense.coordinates() // self.field_size).unbind(dim=-1)
        chosen = (x + y) % 2 == step.iteration % 2
        # Empty slots come last within their tile.
        order = torch.argsort(dense.tile_of_slot() * 2 + ~chosen, stable=True)
        return replace(dense, pixel_ids=torch.where(chosen, dense.pixel_ids, -1)[order], has_empty_slots=True)
