"""The exchanges of colours, records and parameters in place: processes use each other's memory (`peer_memory`).

Between a process's writing and another's reading lies a barrier of the GPUs' streams, and so does between the reading
and the next iteration's writing. Barriers have their own numbers, as two processes may be at two of them:

- `WRITTEN`: colours and flags of all are written -> they are read.
- `DRAWN`: records and radii of all are complete -> they are collected.
- `STEPPED`: all owners have written the new parameters of their rows into the models of all (`SharedModel`), or, with
  an optimizer of own code, all have collected what they need.

`DRAWN` does not stand for `WRITTEN`, as the loss needs the colours before. A process without samples, or without rows,
comes to all barriers. All processes enqueue the same barriers and messages in the same order, and none needs one that
was enqueued later. So none waits for ever.

**Parameters** are written by the owner's step itself into the models of all. Per iteration, a process's stream has

    draw, render, WRITTEN, loss, backward, DRAWN, collect, step, STEPPED

From this follows:

- *A step overwrites nothing that is still read.* Behind `DRAWN` all processes have rendered and gone back to the
  screen; what they still read of the model before `STEPPED` are rows of their own, which nobody else writes.
- *What is rendered has arrived:* it comes after `STEPPED`, and so does everything else that reads a model.
- *A pass overwrites nothing that is still read.* A process comes to `STEPPED` behind what it read of others in `colors`
  and `collect`. Where parameters go by messages, their gather does what `STEPPED` does: it is enqueued after what was
  read, and a process has all rows after every process's own came.
- *Lost iterations* go through all of this, and write nothing. A process that has settled repeats the iteration like any
  other.

**Growth.** All processes grow a memory in the same iteration, as its size is known to all, and let go of the old one,
after a device synchronization. It lives on until none has it mapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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

INSTANCE = 2 + ScreenRecord.SIZE
"""Numbers of radii and record of a Gaussian in a view."""


@dataclass
class _Passes:
    """Memory of all processes for a pass.

    Args:
        memory: every process's, of one size.
        slots, instances: there is room for.
        starts: where status, colors, radii and records begin in a process's memory, in numbers.
        own: this process's.
        views: (rank, views, Gaussians) -> what lies in memory for these.
    """

    memory: PeerMemory
    slots: int
    instances: int
    starts: list[int]
    own: PassMemory
    views: dict[tuple[int, int, int], ScreenRecords] = field(default_factory=dict)


class InPlace:
    """This process's memory for a pass, and the views of every process's.

    Args:
        ranks: all processes.
        share: gives memory that all read, or None.
    """

    def __init__(self, ranks: ProcessRanks, share: Sharing) -> None:
        self._ranks, self._share = ranks, share
        self._held: _Passes | None = None
        self._possible = True

    def reserve(self, device: torch.device) -> None:
        """Take memory before training, enough for what most captures begin with; `prepare` replaces it where it is too
        little. It takes processes longer to map each other's memory than to make an iteration. Every process must call
        this."""
        if self._possible and self._held is None:
            self._take(LEAST // 8, LEAST // INSTANCE, device)

    def prepare(self, engine: SharedEngine, shares: Sequence[Share], gaussians: int, device: torch.device) -> bool:
        """Make room for a pass, which the engine keeps in this memory. Every process must call this.

        Args:
            gaussians: N.

        Returns:
            False: there is no such memory, for none of the processes.
        """
        slots = max(share.num_slots for share in shares)
        instances = max(len(share) for share in shares) * gaussians
        held = self._held
        if self._possible and (held is None or slots > held.slots or instances > held.instances):
            # All processes come here in the same iteration, as their shares are known to all.
            present = (0, 0) if held is None else (held.slots, held.instances)
            if held is not None:
                synchronize(device)  # unmapping waits for the device, with all threads of Python held up
                engine.lend(None)
                self._held = held = None
            slots = with_room(3 * slots) // 3 if slots > present[0] else present[0]
            enough = instances <= present[1]
            self._take(slots, present[1] if enough else with_room(INSTANCE * instances, LEAST) // INSTANCE, device)
        if self._held is None:
            return False
        engine.lend(self._held.own)
        return True

    def _take(self, slots: int, instances: int, device: torch.device) -> None:
        """Take memory for so much, or learn that there is none."""
        sizes = (PassStatus.SIZE, 3 * slots, 2 * instances, ScreenRecord.SIZE * instances)
        starts = aligned_starts(sizes)
        memory = self._share(self._ranks, starts[-1], device)
        self._possible = memory is not None
        if memory is not None:
            part = memory.parts[self._ranks.rank]
            parts = (part[start : start + size] for start, size in zip(starts, sizes, strict=False))
            status, colors, radii, records = parts
            own = PassMemory(status.view(torch.int32), colors, radii.view(torch.int32), records)
            self._held = _Passes(memory, slots, instances, starts, own)

    @property
    def _lent(self) -> _Passes:
        """The memory of the pass that was prepared."""
        if self._held is None:
            raise RuntimeError("no memory is shared: prepare says so")
        return self._held

    def colors(
        self, engine: SharedEngine, shares: Sequence[Share], own: Tensor | None, stop: int, seen: Tensor
    ) -> Tensor:
        """[P, 3] the colours of all samples.

        Args:
            own: [., 3] this process's; None if it has no samples.
            stop: number of the signal by which this process wants all to stop; 0: none.
            seen: [2] int32, written: `SharedEngine.gather`.
        """
        held, overflow = self._lent, engine.overflow
        if own is not None and own.data_ptr() != held.own.colors.data_ptr():
            held.own.colors[: own.numel()].copy_(own.reshape(-1))  # of an engine that keeps no memory
        if overflow is not None and overflow.data_ptr() != held.own.overflow.data_ptr():
            held.own.overflow.copy_(overflow)
        if stop:
            held.own.stop.fill_(stop)
        held.memory.barrier(WRITTEN)
        return engine.gather(held.memory.parts, held.starts[1], [share.num_slots for share in shares], seen)

    def collect(
        self,
        engine: SharedEngine,
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
        self._lent.memory.barrier(DRAWN)
        engine.collect(sources, [share.views.start for share in shares if len(share)], target, row)

    def stepped(self) -> None:
        """What this process enqueues next comes after the steps of all, and after all that the others read of it."""
        self._lent.memory.barrier(STEPPED)

    def _screen_of(self, rank: int, views: int, gaussians: int) -> ScreenRecords:
        """A process's records of its views and all Gaussians, laid out from the start of what its engine was lent.

        Kept for these sizes: slicing takes the host as long as a launch does.
        """
        held, key = self._lent, (rank, views, gaussians)
        if key not in held.views:
            part, (_, _, radii, records, _) = held.memory.parts[rank], held.starts
            count = views * gaussians
            held.views[key] = ScreenRecords(
                part[records : records + ScreenRecord.SIZE * count].view(views, gaussians, ScreenRecord.SIZE),
                part[radii : radii + 2 * count].view(torch.int32).view(views, gaussians, 2),
                with_statistics=False,
            )
        return held.views[key]


class SharedModel:
    """This process's memory for the model, and the models of the others.

    Args:
        ranks: all processes.
        share: gives memory that all write to, or None.
    """

    def __init__(self, ranks: ProcessRanks, share: Sharing) -> None:
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
        starts = aligned_starts([value.numel() for _, value in gaussians.items()])
        if self._possible and starts[-1] > self._room:
            if self._memory is not None:
                synchronize(gaussians.device)  # as in `InPlace`
            self._placed, self._others, self._memory = None, [], None
            self._room = with_room(starts[-1], LEAST)
            self._memory = self._share(self._ranks, self._room, gaussians.device)
            self._possible = self._memory is not None
        if self._memory is None:
            return gaussians
        parts = self._memory.parts
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


def _laid_out(like: Gaussians, part: Tensor, starts: Sequence[int]) -> Gaussians:
    """A model of these shapes in a part of memory, its parameters from these numbers on."""
    values = zip(like.items(), starts, strict=False)
    return Gaussians(**{name: part[at : at + value.numel()].view(value.shape) for (name, value), at in values})
