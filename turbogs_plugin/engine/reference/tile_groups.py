"""The samples of each tile, as losses take sums and means of them."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.types import PixelSamples


class TileGroups:
    """The samples of each tile, with their weights.

    Attributes:
        weights: [P, 1], 0 in unused slots.
        shares: [P, 1], omega: the weights over their sum in the tile.
        tiles: T.
        filled: scalar tensor, the number of filled slots, at least 1.
    """

    def __init__(self, samples: PixelSamples, used: Tensor) -> None:
        """`used`: [P], 1 for the slots that count, 0 for the others, in the dtype of the computation."""
        self.tile_of_slot = samples.tile_of_slot()
        self.tiles = len(samples.tile_ids)
        self.first_slots = samples.tile_offsets[:-1].long().clamp(max=max(0, len(samples) - 1))  # [T]
        self.filled = samples.filled.sum().clamp(min=1).to(used.dtype)
        self.weights = (used if samples.weights is None else used * samples.weights)[:, None]
        totals = self.sum(self.weights)
        self.shares = self.weights / torch.where(totals > 0, totals, 1.0)[self.tile_of_slot]

    def sum(self, values: Tensor) -> Tensor:
        """[P, C] -> [T, C]: sums over the slots of each tile."""
        return values.new_zeros(self.tiles, values.shape[1]).index_add_(0, self.tile_of_slot, values)

    def mean(self, values: Tensor) -> Tensor:
        """[P, C] -> [T, C]: means weighted by the shares."""
        return self.sum(self.shares * values)

    def spread(self, values: Tensor) -> Tensor:
        """[T, C] -> [P, C]: each slot gets its tile's value."""
        return values[self.tile_of_slot]
