"""Rows of tensors over Gaussians: who owns which, and how owners' rows come to all processes.

What depends on the tensors alone is prepared once, for a model keeps its tensors from one change of the set of
Gaussians to the next, and an iteration of a small model is bound by the host.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import is_

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.shared import ModelCopies
from turbogs_plugin.types import Gaussians, GaussianStats

ROW_STEP = 4
"""Runs of rows begin at a multiple of this, so that every parameter of them is aligned to 16 bytes."""


def rows_of(count: int, processes: int) -> list[slice]:
    """The rows that each process owns of a model of `count` Gaussians: equal runs, the last ones shorter."""
    size = -(-count // (processes * ROW_STEP)) * ROW_STEP
    return [slice(min(count, rank * size), min(count, (rank + 1) * size)) for rank in range(processes)]


class RowGather:
    """Overwrites all rows of some tensors by their owners' rows, which are sent as messages.

    A process's message holds its rows of one tensor after the other.

    Args:
        ranks: the owners.
        tensors: [N, ...] each, contiguous, of four bytes an element.
        rows: each process's.
    """

    def __init__(self, ranks: ProcessRanks, tensors: Sequence[Tensor], rows: Sequence[slice]) -> None:
        flat = [value.view(torch.float32).view(len(value), -1) for value in tensors if value.numel()]  # [N, .] each
        ends = np.cumsum([0, *(value.shape[1] for value in flat)])  # of each tensor, in the numbers of one row
        sizes = [int((part.stop - part.start) * ends[-1]) for part in rows]  # the first process's is the largest
        self._ranks = ranks
        self._own = [value[rows[ranks.rank]].view(-1) for value in flat]
        self._sent = flat[0].new_zeros(sizes[0])
        self._filled = self._sent[: sizes[ranks.rank]]
        self._gathered = self._sent.new_empty(ranks.count, sizes[0])
        self._copies: list[tuple[Tensor, Tensor]] = []  # (rows of a tensor, where they lie in a message)
        for rank, part in enumerate(rows):
            if rank == ranks.rank or part.start == part.stop:
                continue
            places = ((part.stop - part.start) * ends).tolist()
            for value, first, end in zip(flat, places[:-1], places[1:], strict=True):
                self._copies.append((value[part].view(-1), self._gathered[rank, first:end]))

    def __call__(self) -> None:
        """Send this process's rows and take in the others'; the device does it before what is enqueued next."""
        torch.cat(self._own, out=self._filled)
        self._ranks.gather(self._sent, self._gathered)
        for target, source in self._copies:
            target.copy_(source)


class OwnedRows:
    """What one process needs to make the step of its rows, as long as the tensors stay.

    Args:
        others: the model in the memory of each other process, to which the step writes as well; None: parameters
            travel as messages.

    Attributes:
        rows: each process's.
        gaussians, moments, stats: this process's rows, views of the tensors.
        copies: of `gaussians`, in the other processes' models.
    """

    def __init__(
        self,
        ranks: ProcessRanks,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
        others: Sequence[Gaussians] | None,
    ) -> None:
        self._tensors = _tensors(gaussians, moments, stats)
        self.rows = rows_of(len(gaussians), ranks.count)
        own = self.rows[ranks.rank]
        self.gaussians = gaussians.map(lambda value: value[own])
        states = vars(moments).items()
        self.moments = replace(moments, **{name: value[own] if value.dim() else value for name, value in states})
        self.stats = None if stats is None else stats.map(lambda value: value[own])
        self.copies: ModelCopies | None = None
        if others is not None:
            self.copies = ModelCopies(self.gaussians, [other.map(lambda value: value[own]) for other in others])
        self._ranks, self._model, self._all_stats = ranks, gaussians, stats
        self._parameters: RowGather | None = None
        self._statistics: RowGather | None = None

    def gather_parameters(self) -> None:
        """Make the parameters of all rows their owners'. Every process must call this."""
        if self._parameters is None:  # takes memory
            self._parameters = RowGather(self._ranks, [value for _, value in self._model.items()], self.rows)
        self._parameters()

    def gather_statistics(self) -> None:
        """Make the statistics of all rows, if there are any, their owners': 32 bytes a Gaussian, and no host waits."""
        if self._all_stats is None:
            return
        if self._statistics is None:
            self._statistics = RowGather(self._ranks, list(vars(self._all_stats).values()), self.rows)
        self._statistics()

    def fits(self, gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> bool:
        """Whether these are still the tensors."""
        present = _tensors(gaussians, moments, stats)
        return len(present) == len(self._tensors) and all(map(is_, present, self._tensors))


def _tensors(gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> list[Tensor]:
    return [*vars(gaussians).values(), *vars(moments).values(), *(() if stats is None else vars(stats).values())]
