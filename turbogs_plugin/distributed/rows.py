"""Rows of tensors over Gaussians: who owns which, and how owners' rows come to all processes.

What depends on the tensors alone is prepared once, for a model keeps its tensors from one change of the set of
Gaussians to the next, and an iteration of a small model is bound by the host.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.types import Gaussians, GaussianStats

ROW_STEP = 4
"""Runs of rows begin at a multiple of this, so that every parameter of them is aligned to 16 bytes."""


def rows_of(count: int, processes: int) -> list[slice]:
    """The rows that each process owns of a model of `count` Gaussians: equal runs, the last ones shorter."""
    size = -(-count // (processes * ROW_STEP)) * ROW_STEP
    return [slice(min(count, rank * size), min(count, (rank + 1) * size)) for rank in range(processes)]


class RowGather:
    """Overwrites all rows of some tensors by their owners' rows.

    Args:
        ranks: of the owners.
        tensors: [N, ...] each, contiguous, of four bytes an element.
        rows: of each process.
    """

    def __init__(self, ranks: ProcessRanks, tensors: Sequence[Tensor], rows: Sequence[slice]) -> None:
        self._ranks = ranks
        flat = [value.view(torch.float32).view(len(value), -1) for value in tensors if value.numel()]
        widths = [value.shape[1] for value in flat]
        own = rows[ranks.rank]
        self._own = [value[own].view(-1) for value in flat]
        self._sent = flat[0].new_zeros((rows[0].stop - rows[0].start) * sum(widths))
        self._filled = self._sent[: (own.stop - own.start) * sum(widths)]
        self._gathered = self._sent.new_empty(ranks.count, len(self._sent))
        self._targets: list[Tensor] = []
        self._sources: list[Tensor] = []
        for rank, part in enumerate(rows):
            if rank == ranks.rank or part.start == part.stop:
                continue
            ends = (part.stop - part.start) * np.cumsum([0, *widths])
            for value, first, end in zip(flat, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
                self._targets.append(value[part].view(-1))
                self._sources.append(self._gathered[rank, first:end])
        self._wait: Callable[[], None] | None = None

    @property
    def under_way(self) -> bool:
        """Whether rows travel, and `finish` is to come."""
        return self._wait is not None

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

    Attributes:
        rows: of each process.
        gaussians, moments, stats: this process's rows, views of the tensors.
        parameters: gathers the parameters of all.
    """

    def __init__(
        self, ranks: ProcessRanks, gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None
    ) -> None:
        self._tensors = _tensors(gaussians, moments, stats)
        self.rows = rows_of(len(gaussians), ranks.count)
        own = self.rows[ranks.rank]
        self.gaussians = gaussians.map(lambda value: value[own])
        states = vars(moments).items()
        self.moments = replace(moments, **{name: value[own] if value.dim() else value for name, value in states})
        self.stats = None if stats is None else stats.map(lambda value: value[own])
        self.parameters = RowGather(ranks, [value for _, value in gaussians.items()], self.rows)
        self._ranks, self._all_stats = ranks, stats
        self._statistics: RowGather | None = None

    def gather_statistics(self) -> None:
        """What is enqueued next comes after the statistics of all rows: 32 bytes a Gaussian, and no host waits."""
        if self._statistics is None:
            self._statistics = RowGather(self._ranks, list(vars(self._all_stats).values()), self.rows)
        self._statistics.begin()
        self._statistics.finish()

    def fits(self, gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> bool:
        """Whether these are still the tensors."""
        present = _tensors(gaussians, moments, stats)
        return len(present) == len(self._tensors) and all(map(lambda a, b: a is b, present, self._tensors))


def _tensors(gaussians: Gaussians, moments: GaussianMoments, stats: GaussianStats | None) -> list[Tensor]:
    return [*vars(gaussians).values(), *vars(moments).values(), *(() if stats is None else vars(stats).values())]
