"""The exchanges of colours, records and parameters in place: processes use each other's memory (`peer_memory`).

Between a process's writing and another's reading lies a barrier of the GPUs' streams, and so does between the reading
and the next iteration's writing. Barriers have their own numbers, as two processes may be at two of them:

- `WRITTEN`: colours and flags of all are written -> they are read.
- `DRAWN`: records and radii of all are complete -> they are collected.
- `STEPPED`: all owners have written the new parameters of their rows into the models of all (`SharedModel`).
- `FREE`: colours, flags, records and radii of the last iteration are read by all -> the projection clears and the
  forward pass overwrites them. Only where rows have no owners.

`DRAWN` does not stand for `WRITTEN`, as the loss needs the colours before, nor `WRITTEN` for `FREE`: the projection
comes before it. A process without samples, or without rows, comes to all barriers. All processes enqueue the same
barriers and messages in the same order, and none needs one that was enqueued later. So none waits for ever.

**Parameters** are written by the owner's step itself into the models of all. Per iteration, a process's stream has

    draw, render, WRITTEN, loss, backward, DRAWN, collect, step, STEPPED

From this follows:

- *A step overwrites nothing that is still read.* Behind `DRAWN` all processes have rendered and gone back to the
  screen; what they still read of the model before `STEPPED` are rows of their own, which nobody else writes.
- *What is rendered has arrived:* it comes after `STEPPED`, and so does everything else that reads a model.
- *`FREE` can be left out* (`stepped`). A process comes to `STEPPED` behind what it read of others in `colors` and
  `collect`. Where parameters go by messages the gather does the same (`ordered`): it is enqueued after what was read,
  and a process has all rows after every process's own came.
- *Lost iterations* go through all of this, and write nothing. A process that has settled repeats the iteration like any
  other.

**Growth.** All processes grow a memory in the same iteration, as its size is known to all, and let go of the old one,
after a device synchronization. It lives on until none has it mapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.peer_memory import LEAST, PeerMemory, Sharing, aligned_starts, share_memory, with_room
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.layout import PassStatus, ScreenRecord
from turbogs_plugin.engine.protocol import Engine, PassMemory
from turbogs_plugin.engine.rendered import ScreenRecords

FREE, WRITTEN, DRAWN, STEPPED = 0, 1, 2, 3
"""Numbers of the barriers."""

INSTANCE = 2 + ScreenRecord.SIZE
"""Numbers of radii and record of a Gaussian in a view."""

SIZES_KEPT = 256
"""Views of the memory are kept for so many sizes of passes; then all are made anew."""


def records_for(views: int, gaussians: int, device: torch.device, with_statistics: bool) -> ScreenRecords:
    """Uninitialised records, and radii, of all these views and Gaussians."""
    return ScreenRecords(
        torch.empty(views, gaussians, ScreenRecord.SIZE, device=device),
        torch.empty(views, gaussians, 2, dtype=torch.int32, device=device),
        with_statistics,
    )


class InPlace:
    """This process's memory for a pass, and the views of those of all.

    Args:
        ranks: of all.
        share: gives memory that all read, or None.
    """

    def __init__(self, ranks: ProcessRanks, share: Sharing = share_memory) -> None:
        self._ranks, self._share = ranks, share
        self._memory: PeerMemory | None = None
        self._possible = True
        self._slots = self._instances = 0  # there is room for
        self._read = False  # others may be reading this process's memory
        self._views: dict[tuple, ScreenRecords] = {}
        self._target: tuple[tuple, ScreenRecords | None] = (), None
        self._own: PassMemory | None = None

    def reserve(self, device: torch.device) -> None:
        """Take memory before training, enough for what most captures begin with; `prepare` replaces it where it is too
        little. It takes processes longer to map each other's memory than to make an iteration. Every process must call
        this."""
        if self._possible and self._memory is None:
            self._slots, self._instances = LEAST // 8, LEAST // INSTANCE
            self._take(device)

    def prepare(self, engine: Engine, shares: Sequence[Share], gaussians: int, device: torch.device) -> bool:
        """Make room for a pass, which the engine keeps in this memory. Every process must call this.

        Args:
            gaussians: N.

        Returns:
            False: there is no such memory, for none of the processes.
        """
        if not self._possible:
            return False
        slots = max(share.num_slots for share in shares)
        instances = max(len(share) for share in shares) * gaussians
        if self._memory is None or slots > self._slots or instances > self._instances:
            self._grow(engine, slots, instances, device)
            if not self._possible:
                return False
        elif self._read:
            self._memory.barrier(FREE)
        self._read = True
        engine.lend(self._own)
        return True

    def ordered(self) -> None:
        """What this process writes next comes after all that the others read, without a barrier."""
        self._read = False

    def stepped(self) -> None:
        """What this process enqueues next comes after the steps of all, and after all that the others read of it."""
        self._memory.barrier(STEPPED)
        self.ordered()

    def _grow(self, engine: Engine, slots: int, instances: int, device: torch.device) -> None:
        """Replace the memory. All processes come here in the same iteration, as their shares are known to all."""
        if self._memory is not None:
            synchronize(device)  # unmapping waits for the device, with all threads of Python held up
            engine.lend(None)
            self._own = self._memory = None
            self._views.clear()
        if slots > self._slots:
            self._slots = with_room(3 * slots) // 3
        if instances > self._instances:
            self._instances = with_room(INSTANCE * instances, LEAST) // INSTANCE
        self._take(device)

    def _take(self, device: torch.device) -> None:
        """Take memory for `_slots` and `_instances`, or learn that there is none."""
        sizes = (PassStatus.SIZE, 3 * self._slots, 2 * self._instances, ScreenRecord.SIZE * self._instances)
        self._starts = aligned_starts(sizes)
        self._read = False
        self._memory = self._share(self._ranks, self._starts[-1], device)
        self._possible = self._memory is not None
        if self._possible:
            part = self._memory.parts[self._ranks.rank]
            parts = (part[start : start + size] for start, size in zip(self._starts, sizes, strict=False))
            status, colors, radii, records = parts
            self._own = PassMemory(status.view(torch.int32), colors, radii.view(torch.int32), records)

    def colors(self, engine: Engine, shares: Sequence[Share], own: Tensor | None, stop: int, seen: Tensor) -> Tensor:
        """[P, 3] the colours of all samples.

        Args:
            own: [., 3] those of this process; None if it has no samples.
            stop: number of the signal by which this process wants all to stop; 0: none.
            seen: [2] int32, written: `Engine.gather`.
        """
        memory, overflow = self._own, engine.overflow
        if own is not None and own.data_ptr() != memory.colors.data_ptr():
            memory.colors[: own.numel()].copy_(own.reshape(-1))  # of an engine that keeps no memory
        if overflow is not None and overflow.data_ptr() != memory.overflow.data_ptr():
            memory.overflow.copy_(overflow)
        if stop:
            memory.stop.fill_(stop)
        self._memory.barrier(WRITTEN)
        counts = [share.num_slots for share in shares]
        return engine.gather(self._memory.parts, self._starts[1], counts, seen)

    def target(self, *sizes: Any) -> ScreenRecords:
        """`records_for` these sizes, for `collect`: the same as at the last call as long as it is for the same."""
        if self._target[0] != sizes:
            self._target = (), None  # lets go of the last ones before there are new ones
            self._target = sizes, records_for(*sizes)
        return self._target[1]

    def collect(
        self,
        engine: Engine,
        shares: Sequence[Share],
        gaussians: int,
        own: ScreenRecords | None,
        target: ScreenRecords,
        row: int,
    ) -> None:
        """Collect the records of all views for some rows.

        Args:
            gaussians: N.
            own: of this process's views and all Gaussians; None if it has no views.
            target: of all views and the rows from `row` on; overwritten, but for records that are off screen.
        """
        sources = [self._screen_of(rank, len(share), gaussians) for rank, share in enumerate(shares) if len(share)]
        if own is not None:
            kept = self._screen_of(self._ranks.rank, len(own.records), gaussians)
            if kept.records.data_ptr() != own.records.data_ptr() or kept.radii.data_ptr() != own.radii.data_ptr():
                kept.records.copy_(own.records)  # of an engine that keeps no memory
                kept.radii.copy_(own.radii)
        self._memory.barrier(DRAWN)
        engine.collect(sources, [share.views.start for share in shares if len(share)], target, row)

    def _screen_of(self, rank: int, views: int, gaussians: int) -> ScreenRecords:
        """Of a process's views and all Gaussians. Laid out as the engine does, from the start of what it was lent.

        Kept for these sizes: slicing takes the host as long as a launch does.
        """
        key = rank, views, gaussians
        found = self._views.get(key)
        if found is None:
            if len(self._views) >= SIZES_KEPT:
                self._views.clear()
            part, (_, _, radii, records, _) = self._memory.parts[rank], self._starts
            count = views * gaussians
            found = self._views[key] = ScreenRecords(
                part[records : records + ScreenRecord.SIZE * count].view(views, gaussians, ScreenRecord.SIZE),
                part[radii : radii + 2 * count].view(torch.int32).view(views, gaussians, 2),
                with_statistics=False,
            )
        return found
