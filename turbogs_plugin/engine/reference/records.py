"""What several processes have rendered of a batch: the colours of all, and records of the screen for some rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import PassStatus
from turbogs_plugin.engine.render_pass import ScreenRecords


def collect_records(sources: Sequence[ScreenRecords], views: Sequence[int], target: ScreenRecords, row: int) -> None:
    """`Engine.collect`. Where a Gaussian is off screen, this copies as well what the sources' records hold."""
    rows, end = slice(row, row + target.records.shape[1]), 0
    for source, view in zip(sources, views, strict=True):
        if view < end:  # shared with the process before
            target.records[view] += source.records[0, rows]
        new, fresh = slice(end - view, None), slice(end, view + len(source.records))
        target.records[fresh], target.radii[fresh] = source.records[new, rows], source.radii[new, rows]
        end = fresh.stop


def gather_colors(parts: Sequence[Tensor], first: int, counts: Sequence[int], seen: Tensor) -> Tensor:
    """`Engine.gather`, without the engine's own flag."""
    statuses = torch.stack([part[: PassStatus.SIZE].view(torch.int32) for part in parts])  # [processes, 3]
    seen.copy_(statuses[:, PassStatus.OVERFLOW :].amax(dim=0))
    pieces = [part[first : first + 3 * count] for part, count in zip(parts, counts, strict=True)]
    return torch.cat(pieces).view(-1, 3)
