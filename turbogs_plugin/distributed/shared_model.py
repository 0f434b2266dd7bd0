"""The model in memory that all processes write to: an owner's step changes its rows in the models of all.

`in_place` says when it does, and why nobody reads them then.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.peer_memory import LEAST, PeerMemory, Sharing, aligned_starts, share_memory, with_room
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.types import Gaussians


class SharedModel:
    """This process's memory for the model, and the models of the others.

    Args:
        ranks: of all.
        share: gives memory that all write to, or None.
    """

    def __init__(self, ranks: ProcessRanks, share: Sharing = share_memory) -> None:
        self._ranks, self._share = ranks, share
        self._memory: PeerMemory | None = None
        self._possible = True
        self._room = 0
        self._placed: Gaussians | None = None
        self._others: list[Gaussians] = []

    def place(self, gaussians: Gaussians) -> Gaussians:
        """Copy a model into this memory, over the one placed before, of which nothing is left. Every process must call
        this, with models of one size, when no step is under way.

        Returns:
            The model there; the given one, where there is no such memory.
        """
        if not self._possible:
            return gaussians
        starts = aligned_starts([value.numel() for _, value in gaussians.items()])
        if self._memory is None or starts[-1] > self._room:
            if self._memory is not None:
                synchronize(gaussians.device)  # as in `InPlace`
            self._placed, self._others, self._memory = None, [], None
            self._room = with_room(starts[-1], LEAST)
            self._memory = self._share(self._ranks, self._room, gaussians.device)
            if self._memory is None:
                self._possible = False
                return gaussians
        models = [_laid_out(gaussians, part, starts) for part in self._memory.parts]
        own = models.pop(self._ranks.rank)
        # Their memory may overlap: a model that lies there already, of another size.
        fresh = gaussians.map(torch.clone) if self._holds(gaussians) else gaussians
        for name, value in own.items():
            value.copy_(getattr(fresh, name))
        self._placed, self._others = own, models
        return own

    def others(self, gaussians: Gaussians) -> list[Gaussians] | None:
        """The same model in the memory of each other process; None where it was not placed here."""
        return self._others if gaussians is self._placed else None

    def _holds(self, gaussians: Gaussians) -> bool:
        own = self._memory.parts[self._ranks.rank]
        return gaussians.means.untyped_storage().data_ptr() == own.untyped_storage().data_ptr()


def _laid_out(like: Gaussians, part: Tensor, starts: Sequence[int]) -> Gaussians:
    """A model of these shapes in a part of memory, its parameters from these numbers on."""
    values = zip(like.items(), starts, strict=False)
    return Gaussians(**{name: part[at : at + value.numel()].view(value.shape) for (name, value), at in values})
