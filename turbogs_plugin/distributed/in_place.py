"""The exchanges of colours, records and parameters in place: processes use each other's memory (`peer_memory`).

Between a process's writing and another's reading lies a barrier of the GPUs' streams, and so does between the reading
and the next iteration's writing. Barriers have their own numbers, as two processes may be at two of them:

- `WRITTEN`: colours and flags of all are written -> they are read.
- `DRAWN`: records and radii of all are complete -> they are collected.
- `STEPPED`: all owners have written the new parameters of their rows into the models of all, or, with an optimizer of
  own code, all have collected what they need.

`DRAWN` does not stand for `WRITTEN`, as the loss needs the colours before. A process without samples, or without rows,
comes to all barriers. All processes enqueue barriers and messages in one order, and none needs one that was enqueued
later. So none waits for ever.

**Parameters** are written by the owner's step itself into the models of all. Per iteration, a process's stream has

    draw, render, WRITTEN, loss, backward, DRAWN, collect, step, STEPPED

From this follows:

- *A step overwrites nothing that is still read.* Behind `DRAWN` all processes have rendered and gone back to the
  screen; what they still read of the model before `STEPPED` are rows of their own, which nobody else writes.
- *What is rendered has arrived:* it comes after `STEPPED`, and so does everything else that reads a model.
- *A pass overwrites nothing that is still read.* A process comes to `STEPPED` behind what it read of others in `colors`
  and `collect`.
- *Lost iterations* go through all of this, and write nothing. A process that has settled repeats the iteration like any
  other.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.peer_memory import LEAST, PeerMemory, Sharing, aligned_starts, with_room
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.layout import PassStatus, ScreenRecord
from turbogs_plugin.engine.render_pass import ScreenRecords
from turbogs_plugin.engine.shared import PassMemory, SharedEngine
from turbogs_plugin.types import Gaussians

WRITTEN, DRAWN, STEPPED = 1, 2, 3
"""Numbers of the barriers. Number 0 is `peer_memory`'s own."""

RECORD, RADII = ScreenRecord.SIZE, 2
"""Numbers of a record, and radii, of a Gaussian in a view."""


class InPlace:
    """This process's memory for the passes of its engine and for the model, and views of every process's. `share` gives
    memory that all read and write, or None; it is not asked again then."""

    def __init__(self, engine: SharedEngine, ranks: ProcessRanks, share: Sharing) -> None:
        self._engine, self._ranks, self._share, self._possible = engine, ranks, share, True
        self._passes: tuple[PeerMemory, PassMemory] | None = None  # of all processes, and this one's
        self._slots = self._instances = 0  # there is room for
        self._starts: list[int] = []  # of status, colors, radii and records in a process's memory, in numbers
        self._model: PeerMemory | None = None
        self._model_room = 0
        self._placed: Gaussians | None = None
        self._others: list[Gaussians] = []

    def place(self, gaussians: Gaussians) -> Gaussians:
        """Copy a model into this memory, over the one placed before, of which nothing is left, and return it; the given
        one, where there is no such memory. Every process must call this, with models of one size, between steps."""
        starts = aligned_starts([value.numel() for _, value in gaussians.items()])
        if starts[-1] > self._model_room:
            if self._model is not None:
                synchronize(gaussians.device)  # as in `prepare`
            self._placed, self._others, self._model = None, [], None
            self._model_room = max(LEAST, with_room(starts[-1]))
            self._model = self._take(self._model_room, gaussians.device)
        if self._passes is None:  # before training: to map memory takes longer than an iteration
            self._reserve(LEAST // 8, LEAST // (RECORD + RADII), gaussians.device)
        if self._model is None:
            return gaussians
        parts = self._model.parts
        models = [_laid_out(gaussians, part, starts) for part in parts]
        own = models.pop(self._ranks.rank)
        # A model that lies in this memory already, of another size, may overlap its new place.
        held = parts[self._ranks.rank].untyped_storage().data_ptr()
        inside = gaussians.means.untyped_storage().data_ptr() == held
        fresh = gaussians.map(torch.clone) if inside else gaussians
        for name, value in own.items():
            value.copy_(getattr(fresh, name))
        self._placed, self._others = own, models
        return own

    def others(self, gaussians: Gaussians) -> list[Gaussians] | None:
        """The model in the memory of each other process; None where `gaussians` was not placed here."""
        return self._others if gaussians is self._placed else None

    def prepare(self, shares: Sequence[Share], gaussians: int, device: torch.device) -> bool:
        """Make room for a pass of N `gaussians`, which the engine keeps in this memory. Every process must call this.
        Returns False where no process has such memory, or engines do not keep passes there."""
        slots = max(share.num_slots for share in shares)
        instances = max(len(share) for share in shares) * gaussians
        if slots > self._slots or instances > self._instances:
            # All processes come here in one iteration, as their shares are known to all. The old memory lives on until
            # none has it mapped.
            if self._passes is not None:
                synchronize(device)  # unmapping waits for the device, with all threads of Python held up
                self._engine.lend(None)
                self._passes = None
            slots = with_room(slots) if slots > self._slots else self._slots
            instances = with_room(instances) if instances > self._instances else self._instances
            self._reserve(slots, instances, device)
        return self._passes is not None and self._engine.lend(self._passes[1])

    def _reserve(self, slots: int, instances: int, device: torch.device) -> None:
        """Take memory for passes of these sizes."""
        self._slots, self._instances = slots, instances
        sizes = PassStatus.SIZE, 3 * slots, RADII * instances, RECORD * instances
        self._starts = aligned_starts(sizes)
        memory = self._take(self._starts[-1], device)
        if memory is not None:
            part = memory.parts[self._ranks.rank]
            parts = [part[start : start + size] for start, size in zip(self._starts, sizes, strict=False)]
            status, colors, radii, records = parts
            self._passes = memory, PassMemory(status.view(torch.int32), colors, radii.view(torch.int32), records)

    def _take(self, size: int, device: torch.device) -> PeerMemory | None:
        """Memory of every process, `size` numbers each; or None, for good."""
        memory = self._share(self._ranks, size, device) if self._possible else None
        self._possible = memory is not None
        return memory

    def colors(self, shares: Sequence[Share], own: Tensor | None, seen: Tensor) -> Tensor:
        """[P, 3] the colours of all samples. `own`: [., 3] this process's, in the memory that its engine was lent; None
        if it has no samples. `seen`: [2] int32, written: `SharedEngine.gather`."""
        assert self._passes is not None, "prepare says that there is no memory"
        memory, lent = self._passes
        if self._ranks.asked:
            lent.status[PassStatus.STOP].fill_(self._ranks.asked)
        memory.barrier(WRITTEN)
        return self._engine.gather(memory.parts, self._starts[1], [share.num_slots for share in shares], seen)

    def collect(
        self, shares: Sequence[Share], rows: Sequence[slice], own: ScreenRecords | None, target: ScreenRecords
    ) -> None:
        """Collect the records of all views for this process's rows.

        Args:
            rows: what each process collects; the last one ends with N, the number of Gaussians.
            own: of this process's views and all Gaussians, in the memory lent to its engine; None: it has no views.
            target: of all views and this process's rows; overwritten, but for records that are off screen.
        """
        assert self._passes is not None
        memory, _ = self._passes
        memory.barrier(DRAWN)
        drawn = [(rank, share) for rank, share in enumerate(shares) if len(share)]
        sources = [self._screen(memory.parts[rank], len(share), rows[-1].stop) for rank, share in drawn]
        firsts, row = [share.views.start for _, share in drawn], rows[self._ranks.rank].start
        self._engine.collect(sources, firsts, target, row)

    def stepped(self, model: Gaussians | None = None) -> None:
        """Put what this process enqueues next after the steps of all, and after all that the others read of it."""
        assert self._passes is not None
        self._passes[0].barrier(STEPPED)

    def _screen(self, part: Tensor, views: int, gaussians: int) -> ScreenRecords:
        """A process's records [V, N, .], laid out from the start of what its engine was lent."""
        radii, records = (part.storage_offset() + start for start in self._starts[2:4])
        shapes = [((views, gaussians, size), (gaussians * size, size, 1)) for size in (RECORD, RADII)]
        # By as_strided, one operation: slicing takes the host as long as a launch does.
        return ScreenRecords(part.as_strided(*shapes[0], records), part.as_strided(*shapes[1], radii).view(torch.int32))


def _laid_out(like: Gaussians, part: Tensor, starts: Sequence[int]) -> Gaussians:
    """A model of these shapes in a part of memory, its parameters from these numbers on."""
    values = zip(like.items(), starts, strict=False)
    return Gaussians(**{name: part[at : at + value.numel()].view(value.shape) for (name, value), at in values})
