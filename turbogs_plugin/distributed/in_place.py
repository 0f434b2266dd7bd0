"""The exchanges of colours, records and parameters in place: processes read each other's memory (`peer_memory`).

Between a process's writing and another's reading lies a barrier of the GPUs' streams, and so does between the reading
and the next iteration's writing. Barriers have their own numbers, as two processes may be at two of them:

- `WRITTEN`: colours and flags of all are written -> they are read.
- `DRAWN`: records and radii of all are complete -> they are collected.
- `PACKED`: all owners have packed the parameters of their rows, after their step -> they are copied into the models.
- `FREE`: colours, flags, records and radii of the last iteration are read by all -> the projection clears and the
  forward pass overwrites them. Only where rows have no owners.

`DRAWN` does not stand for `WRITTEN`, as the loss needs the colours before, nor `WRITTEN` for `FREE`: the projection
comes before it. A process without samples, or without rows, comes to all barriers. All processes enqueue the same
barriers and messages in the same order, and none needs one that was enqueued later. So none waits for ever, even if a
GPU should do its two streams' work in the order in which it was enqueued.

**Parameters** travel beside the next draw of pixels. Per iteration, a process's main stream has

    render, WRITTEN, loss, backward, DRAWN, collect, step, pack | next draw | wait for the copies, render, ...

and its side stream has `PACKED` and the copies, after what the main stream was given up to the pack (`OwnedRows.begin`,
by an event), and before what it is given from `OwnedRows.finish` on (by another). Nobody reads or renders a model
before `Exchange.finish`. From this follows:

- *Copies read what is packed:* pack, event, `PACKED` of all, copies. They overwrite rows of others in this process's
  model, which its main stream may have read until the pack; the same event keeps them behind that.
- *The next pack overwrites nothing that is still read.* A process's copies end before it renders the next pass, by
  `finish`; so before its `WRITTEN` and `DRAWN` of that pass. Every process packs behind those barriers. A pass by
  messages has no such barriers, but then parameters go by messages, too: a pack into this memory always comes after a
  pass in place, and that after the last copies.
- *`FREE` can be left out* (`ordered`). A process that renders the next pass has its copies behind it, so `PACKED` of
  all; each comes, by the event, after what that process read of others in `colors` and `collect`. Where parameters go
  by messages the gather does the same: it is enqueued after what was read, and a process has all rows after every
  process's own came.
- *Lost iterations* go through all of this, and copy what did not change. A process that has settled repeats the
  iteration like any other.
- *Memory.* What is written (the tensors of the model) was allocated for the main stream. Who replaces the model, by an
  event of density control or a state that is loaded, calls `finish` before; memory that is used again after that is
  used behind the copies. Nothing is allocated on the side stream.

**Growth.** All processes grow a memory in the same iteration, as its size is known to all, and let go of the old one,
after a device synchronization. It lives on until none has it mapped.

- That of passes grows in `prepare`. `finish` came before, and the device waits for the copies as well; they are of
  another memory, anyway.
- That of rows is asked for when an iteration packs for the first time with a new set of Gaussians, when none are under
  way. This iteration's `DRAWN` is past on this device, so all others have read what was packed last.

If the memory of rows cannot be had, where that of passes can, parameters go by messages from then on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.peer_memory import PeerMemory, share_memory
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.distributed.side_stream import SideStream
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.rendered import ScreenRecords

FREE, WRITTEN, DRAWN, PACKED = 0, 1, 2, 3
"""Numbers of the barriers."""

GROWTH = 1.25
"""Memory that must grow gets this factor of the size asked for."""

ALIGNMENT = 64
"""The parts of the memory begin at a multiple of so many numbers."""

FLAGS = 3
"""Numbers of a pass's flags."""

SIZES_KEPT = 256
"""Views of the memory are kept for so many sizes of passes; then all are made anew."""


class InPlace:
    """This process's memory for colours and records and that for parameters, and the views of those of all.

    Args:
        ranks: of all.
        share: gives memory that all read, or None.
        beside: gives what lets parameters travel beside other work.

    Attributes:
        flags: three times [1] float32, this process's flags of a pass.
    """

    flags: Sequence[Tensor]

    def __init__(
        self,
        ranks: ProcessRanks,
        share: Callable[[ProcessRanks, int, torch.device], PeerMemory | None] = share_memory,
        beside: Callable[[torch.device], SideStream] = SideStream,
    ) -> None:
        self._ranks, self._share, self._beside = ranks, share, beside
        self._memory: PeerMemory | None = None
        self._possible = True
        self._slots = self._instances = 0  # there is room for
        self._read = False  # others may be reading this process's memory
        self._views: dict[tuple, list[Tensor] | ScreenRecords] = {}
        self._rows: PeerMemory | None = None
        self._rows_possible = True
        self._row_numbers = 0  # there is room for
        self._side: SideStream | None = None

    def prepare(self, engine: Engine, shares: Sequence[Share], gaussians: int, device: torch.device) -> bool:
        """Make room for a pass, in which the engine keeps its records in this memory. Every process must call this.

        Args:
            gaussians: N.

        Returns:
            False: there is no such memory, for none of the processes.
        """
        if not self._possible:
            return False
        slots = max(share.slots.stop - share.slots.start for share in shares)
        instances = max(len(share) for share in shares) * gaussians
        if self._memory is None or slots > self._slots or instances > self._instances:
            self._grow(engine, slots, instances, device)
            if self._memory is None:
                self._possible = False
                return False
        elif self._read:
            self._memory.barrier(FREE)
        self._read = True
        engine.lend(self._own_records, self._own_radii)
        return True

    def ordered(self) -> None:
        """What this process writes next comes after all that the others read, without a barrier."""
        self._read = False

    def rows(self, size: int, device: torch.device) -> tuple[PeerMemory, SideStream] | None:
        """Memory for the rows of each process, and the stream to copy them on. Every process must call this, with none
        of them under way and no view of an earlier such memory kept.

        Args:
            size: numbers that a process has at most.

        Returns:
            None: there is no such memory, for none of the processes.
        """
        if not self._rows_possible:
            return None
        if self._rows is None or size > self._row_numbers:
            if self._rows is not None:
                synchronize(device)  # as in `_grow`
                self._rows = None
            self._row_numbers = int(GROWTH * size)
            self._rows = self._share(self._ranks, self._row_numbers, device)
            if self._rows is None:
                self._rows_possible = False
                return None
        if self._side is None:
            self._side = self._beside(device)
        return self._rows, self._side

    def _grow(self, engine: Engine, slots: int, instances: int, device: torch.device) -> None:
        """Replace the memory. All processes come here in the same iteration, as their shares are known to all."""
        if self._memory is not None:
            synchronize(device)  # unmapping waits for the device, with all threads of Python held up
            engine.lend(None, None)
            self._own_records = self._own_radii = self._memory = None
            self.flags = ()
            self._views.clear()
        slots = int(GROWTH * slots) if slots > self._slots else self._slots
        instances = int(GROWTH * instances) if instances > self._instances else self._instances
        sizes = (FLAGS, 3 * slots, 2 * instances, ScreenRecord.SIZE * instances)
        starts = [0]
        for size in sizes:
            starts.append(starts[-1] + -(-size // ALIGNMENT) * ALIGNMENT)
        self._starts = starts
        self._slots, self._instances, self._read = slots, instances, False
        self._memory = self._share(self._ranks, starts[-1], device)
        if self._memory is not None:
            own = self._memory.parts[self._ranks.rank]
            flags, _, radii, records = (own[start : start + size] for start, size in zip(starts, sizes, strict=False))
            self.flags, self._own_records, self._own_radii = flags.split(1), records, radii.view(torch.int32)

    def colors(self, shares: Sequence[Share], own: Tensor | None) -> tuple[Tensor, Tensor]:
        """([P, 3] the colours of all samples, [3] the largest of each flag of all).

        Args:
            own: [., 3] those of this process; None if it has no samples.
        """
        counts = tuple(share.slots.stop - share.slots.start for share in shares)
        parts = self._kept(self._colors_of, *counts)
        if own is not None:
            parts[self._ranks.rank].copy_(own)
        self._memory.barrier(WRITTEN)
        gathered = torch.cat(parts)  # [P + ranks, 3]
        samples = sum(counts)
        return gathered[:samples], gathered[samples:].amax(dim=0)

    def _colors_of(self, *counts: int) -> list[Tensor]:
        """[., 3] the colours of each process, then [1, 3] the flags of each."""
        parts, start = self._memory.parts, self._starts[1]
        colors = [part[start : start + 3 * count].view(count, 3) for part, count in zip(parts, counts, strict=True)]
        return colors + [part[:FLAGS].view(1, FLAGS) for part in parts]

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
        if own is not None:
            kept = self._kept(self._screen_of, self._ranks.rank, len(own.records), gaussians)
            if kept.records.data_ptr() != own.records.data_ptr() or kept.radii.data_ptr() != own.radii.data_ptr():
                kept.records.copy_(own.records)  # of an engine that keeps no memory
                kept.radii.copy_(own.radii)
        self._memory.barrier(DRAWN)
        for rank, share in enumerate(shares):
            if len(share):
                source = self._kept(self._screen_of, rank, len(share), gaussians)
                engine.collect(source, target, row, share.views.start, share.continues)

    def _screen_of(self, rank: int, views: int, gaussians: int) -> ScreenRecords:
        """Of a process's views and all Gaussians. Laid out as the engine does, from the start of what it was lent."""
        part, (_, _, radii, records, _) = self._memory.parts[rank], self._starts
        count = views * gaussians
        return ScreenRecords(
            part[records : records + ScreenRecord.SIZE * count].view(views, gaussians, ScreenRecord.SIZE),
            part[radii : radii + 2 * count].view(torch.int32).view(views, gaussians, 2),
            with_statistics=False,
        )

    def _kept(self, make: Callable, *sizes: int) -> list[Tensor] | ScreenRecords:
        """What `make` gives for these sizes: slicing takes the host as long as a launch does."""
        key = make.__name__, sizes
        found = self._views.get(key)
        if found is None:
            if len(self._views) >= SIZES_KEPT:
                self._views.clear()
            found = self._views[key] = make(*sizes)
        return found
