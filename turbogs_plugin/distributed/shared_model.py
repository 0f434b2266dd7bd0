"""The model in memory that all processes write to: an owner's step changes its rows in the models of all.

`in_place` says when it does, and why nobody reads them then.
"""

from __future__ import annotations

from itertools import pairwise

import torch

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
        models = []
        for part in self._memory.parts:
            places = iter(pairwise(starts))

            def placed(value: torch.Tensor, part: torch.Tensor = part, places=places) -> torch.Tensor:
                return part[next(places)[0] :][: value.numel()].view(value.shape)

            models.append(gaussians.map(placed))
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
