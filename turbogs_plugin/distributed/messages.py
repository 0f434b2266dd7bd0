"""The exchange of colours, records and parameters by messages, where GPUs do not use each other's memory.

All messages are flat float32 tensors; integers travel as their bits. Every process knows the shares and rows of all,
and so the size of every message.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from turbogs_plugin.distributed.in_place import RADII
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.layout import PassStatus, ScreenRecord
from turbogs_plugin.engine.render_pass import ScreenRecords
from turbogs_plugin.engine.shared import SharedEngine, collect_records
from turbogs_plugin.types import Gaussians

ROW_STEP = 4
"""Runs of rows begin at a multiple of this, so that every parameter of them is aligned to 16 bytes."""


class Messages:
    """What several processes send each other in an iteration: the counterpart of `in_place.InPlace`."""

    def __init__(self, engine: SharedEngine, ranks: ProcessRanks) -> None:
        self._engine, self._ranks = engine, ranks

    def colors(self, shares: Sequence[Share], own: Tensor | None, seen: Tensor) -> Tensor:
        """[P, 3] the colours of all samples, by a message of status and colours. Arguments as of `InPlace.colors`."""
        status = torch.zeros(PassStatus.SIZE, dtype=torch.int32, device=seen.device)
        status[PassStatus.STOP] = self._ranks.asked
        if self._engine.overflow is not None:
            status[PassStatus.OVERFLOW :][:1] = self._engine.overflow
        flat = [] if own is None else [own.flatten()]
        message = torch.cat([status.view(torch.float32), *flat])
        counts = [share.num_slots for share in shares]
        parts = self._ranks.exchange([message] * self._ranks.count, [PassStatus.SIZE + 3 * count for count in counts])
        # In torch: for many processes, too.
        return SharedEngine.gather(self._engine, parts, PassStatus.SIZE, counts, seen)

    def collect(
        self, shares: Sequence[Share], rows: Sequence[slice], own: ScreenRecords | None, target: ScreenRecords
    ) -> None:
        """Send every process the records of its rows in this process's views, and put together what all send. Arguments
        as of `InPlace.collect`."""
        count = target.records.shape[1]
        sent = [torch.empty(0, device=target.records.device)] * len(rows)
        if own is not None:
            pieces = [(own.records[:, part], own.radii[:, part].view(torch.float32)) for part in rows]
            sent = [torch.cat([piece.flatten() for piece in pair]) for pair in pieces]
        instances = [len(share) * count for share in shares]
        received = self._ranks.exchange(sent, [(ScreenRecord.SIZE + RADII) * number for number in instances])
        sources, firsts = [], []
        for share, message, number in zip(shares, received, instances, strict=True):
            if len(share):
                records, radii = message.split([ScreenRecord.SIZE * number, RADII * number])
                records = records.view(len(share), count, ScreenRecord.SIZE)
                radii = radii.view(torch.int32).view(len(share), count, RADII)
                sources.append(ScreenRecords(records, radii))
                firsts.append(share.views.start)
        collect_records(sources, firsts, target, 0)

    def stepped(self, model: Gaussians | None = None) -> None:
        """Bring the owners' new parameters to all processes. `model`: None where every process made the whole step."""
        if model is not None:
            gather_rows(self._ranks, [value for _, value in model.items()])


def rows_of(count: int, processes: int) -> list[slice]:
    """The rows that each process owns of a model of `count` Gaussians: equal runs, the last ones shorter."""
    size = -(-count // (processes * ROW_STEP)) * ROW_STEP
    return [slice(min(count, rank * size), min(count, (rank + 1) * size)) for rank in range(processes)]


def gather_rows(ranks: ProcessRanks, tensors: Sequence[Tensor]) -> None:
    """Overwrite all rows of some tensors by their owners', by a message that holds one tensor after the other. Each is
    [N, ...], contiguous, of four bytes an element."""
    rows = rows_of(len(tensors[0]), ranks.count)
    flat = [value.view(torch.float32).view(len(value), -1) for value in tensors if value.numel()]  # [N, .] each
    widths = [value.shape[1] for value in flat]
    counts = [part.stop - part.start for part in rows]
    own = torch.cat([value[rows[ranks.rank]].flatten() for value in flat])
    messages = ranks.exchange([own] * ranks.count, [sum(widths) * count for count in counts])
    for part, count, message in zip(rows, counts, messages, strict=True):
        pieces = message.split([width * count for width in widths])
        for value, width, piece in zip(flat, widths, pieces, strict=True):
            value[part] = piece.view(count, width)
