"""Memory of processes on CPUs that all of them use in place: files that all have mapped. And an engine that keeps what
passes leave there, as a GPU's engine does."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import torch
from helpers.losing_engine import LosingEngine
from torch import Tensor

from turbogs_plugin.distributed.peer_memory import PeerMemory
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.engine.layout import PassStatus, ScreenRecord
from turbogs_plugin.engine.render_pass import ScreenRecords
from turbogs_plugin.engine.shared import PassMemory


class PeerFiles:
    """`share_memory` by files of a folder.

    Args:
        pauses: seconds, at most, that a process waits before and after a barrier, so that a missing one shows.
        most: memories that can be had; then there are none. None: as many as wanted.
    """

    def __init__(self, folder: Path, pauses: float = 0.004, most: int | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.pauses, self.most = folder, pauses, most
        self.sizes: list[int] = []  # of each memory that was made
        self.refused = 0  # how often there was none
        self.barriers: list[int] = []  # the numbers of all

    def __call__(self, ranks: ProcessRanks, size: int, device: torch.device) -> PeerMemory | None:
        if self.most is not None and len(self.sizes) >= self.most:
            self.refused += 1
            return None
        paths = [self.folder / f"{len(self.sizes)}-{rank}" for rank in range(ranks.count)]
        self.sizes.append(size)
        paths[ranks.rank].write_bytes(bytes(4 * size))
        torch.distributed.barrier()
        parts = [torch.from_file(str(path), shared=True, size=size, dtype=torch.float32) for path in paths]
        unequal = random.Random(ranks.rank)

        def barrier(channel: int) -> None:
            self.barriers.append(channel)
            time.sleep(unequal.random() * self.pauses)
            torch.distributed.barrier()
            time.sleep(unequal.random() * self.pauses)

        return PeerMemory(parts, barrier)


class _Forwarding:
    """An object of which some methods are replaced."""

    def __init__(self, wrapped: Any, engine: KeepingEngine) -> None:
        self._wrapped, self._engine = wrapped, engine

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)


class _Rendered(_Forwarding):
    def backward(self, *arguments: Any, **options: Any) -> _Screen:
        return _Screen(self._wrapped.backward(*arguments, **options), self._engine)


class _Screen(_Forwarding):
    def plain(self) -> ScreenRecords:
        plain = self._wrapped.plain()
        if self._engine.lent is None:
            return plain
        kept = ScreenRecords(*self._engine.views(*plain.records.shape[:2]))
        kept.records.copy_(plain.records)
        kept.radii.copy_(plain.radii)
        return kept


class KeepingEngine(LosingEngine):
    """The projection of a pass destroys what is in the memory lent; the forward and the backward pass write there."""

    def __init__(self, lose: int | None = None) -> None:
        super().__init__(lose)
        self.lent: PassMemory | None = None

    def lend(self, memory: PassMemory | None) -> bool:
        if memory is not self.lent:
            flag = torch.zeros(1, dtype=torch.int32) if memory is None else memory.status[PassStatus.OVERFLOW :][:1]
            self.flag = flag.copy_(self.flag)
        self.lent = memory
        return True

    def views(self, views: int, count: int) -> tuple[Tensor, Tensor]:
        size = views * count
        return (
            self.lent.records[: ScreenRecord.SIZE * size].view(views, count, ScreenRecord.SIZE),
            self.lent.radii[: 2 * size].view(views, count, 2),
        )

    def render(self, gaussians: Any, cameras: Any, *arguments: Any) -> _Rendered:
        if self.lent is not None:
            records, radii = self.views(len(cameras), len(gaussians))
            records.fill_(torch.nan)
            radii.fill_(-7)
            self.lent.colors.fill_(torch.nan)
        rendered = super().render(gaussians, cameras, *arguments)
        if self.lent is not None:
            colors = self.lent.colors[: rendered.colors.numel()].view(rendered.colors.shape)
            rendered.colors = colors.copy_(rendered.colors)
        return _Rendered(rendered, self)
