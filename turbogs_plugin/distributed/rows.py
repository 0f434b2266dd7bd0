"""Rows of tensors over Gaussians: who owns which, and how owners' rows come to all processes.

What depends on the tensors alone is prepared once, for a model keeps its tensors from one change of the set of
Gaussians to the next, and an iteration of a small model is bound by the host.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import is_

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import ModelCopies
from turbogs_plugin.types import Gaussians, GaussianStats

ROW_STEP = 4
"""Runs of rows begin at a multiple of this, so that every parameter of them is aligned to 16 bytes."""


def rows_of(count: int, processes: int) -> list[slice]:
    """The rows that each process owns of a model of `count` Gaussians: equal runs, the last ones shorter."""
    size = -(-count // (processes * ROW_STEP)) * ROW_STEP
    return [slice(min(count, rank * size), min(count, (rank + 1) * size)) for rank in range(processes)]


class Packing:
    """How the rows of some tensors lie in a part of memory for each process: one tensor after the other.

    Args:
        tensors: [N, ...] each, contiguous, of four bytes an element.
        rows: of each process.

    Attributes:
        size: numbers of the largest part, the first process's.
    """

    def __init__(self, tensors: Sequence[Tensor], rows: Sequence[slice]) -> None:
        self._flat = [value.view(torch.float32).view(len(value), -1) for value in tensors if value.numel()]
        self._rows = rows
        self._ends = np.cumsum([0, *(value.shape[1] for value in self._flat)])  # of a row of each tensor
        self.size = self.filled(0)

    def filled(self, rank: int) -> int:
        """Numbers of a process's part that mean something."""
        return (self._rows[rank].stop - self._rows[rank].start) * int(self._ends[-1])

    def own(self, rank: int) -> list[Tensor]:
        """A process's rows of each tensor, [.] each."""
        return [value[self._rows[rank]].view(-1) for value in self._flat]

    def of_others(self, rank: int, parts: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """The rows of all processes but one.

        Args:
            rank: that one.
            parts: [size] or more, of each process.

        Returns:
            ([.] each in the tensors, [.] each where it lies in the parts).
        """
        targets, sources = [], []
        for other, rows in enumerate(self._rows):
            if other == rank or rows.start == rows.stop:
                continue
            ends = ((rows.stop - rows.start) * self._ends).tolist()
            for value, first, end in zip(self._flat, ends[:-1], ends[1:], strict=True):
                targets.append(value[rows].view(-1))
                sources.append(parts[other][first:end])
        return targets, sources


class RowGather:
    """Overwrites all rows of some tensors by their owners' rows, which are sent as messages.

    Args:
        ranks: of the owners.
        packing: of the rows.
    """

    def __init__(self, ranks: ProcessRanks, packing: Packing) -> None:
        self._ranks = ranks
        self._own = packing.own(ranks.rank)
        self._sent = self._own[0].new_zeros(packing.size)
        self._filled = self._sent[: packing.filled(ranks.rank)]
        self._gathered = self._sent.new_empty(ranks.count, len(self._sent))
        self._targets, self._sources = packing.of_others(ranks.rank, self._gathered)
        self._wait: Callable[[], None] | None = None

    def begin(self) -> None:
        """Pack this process's rows and let them travel, beside other work."""
        torch.cat(self._own, out=self._filled)
        self._wait = self._ranks.begin_gather(self._sent, self._gathered)

    def finish(self) -> None:
        """What is enqueued next comes after the rows of all, which must be under way."""
        self._wait()
        self._wait = None
        if self._targets:
            torch._foreach_copy_(self._targets, self._sources)


class OwnedRows:
    """What one process needs to make the step of its rows, as long as the tensors are the same.

    Args:
        others: the model in the memory of each other process, to which the step writes as well; None: parameters
            travel as messages.

    Attributes:
        rows: of each process.
        gaussians, moments, stats: this process's rows, views of the tensors.
        copies: of `gaussians`, in the other processes' models.
        under_way: parameters travel as messages, and `finish` is to come.
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
        self.under_way = False

    def begin(self) -> None:
        """Let the parameters of this process's rows travel to all as messages, beside other work. Every process must
        call this."""
        if self._parameters is None:  # takes memory
            packing = Packing([value for _, value in self._model.items()], self.rows)
            self._parameters = RowGather(self._ranks, packing)
        self._parameters.begin()
        self.under_way = True

    def finish(self) -> None:
        """What is enqueued next comes after the parameters of all, which must be under way."""
        self._parameters.finish()
        self.under_way = False

    def gather_statistics(self) -> None:
        """What is enqueued next comes after the statistics of all rows: 32 bytes a Gaussian, and no host waits."""
        if self._statistics is None:
            self._statistics = RowGather(self._ranks, Packing(list(vars(self._all_stats).values()), self.rows))
        self._statistics.begin()
        self._statistics.finish()

    def fits(self, gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> bool:
        """Whether these are still the tensors."""
        present = _tensors(gaussians, moments, stats)
        return len(present) == len(self._tensors) and all(map(is_, present, self._tensors))


def _tensors(gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> list[Tensor]:
    return [*vars(gaussians).values(), *vars(moments).values(), *(() if stats is None else vars(stats).values())]
