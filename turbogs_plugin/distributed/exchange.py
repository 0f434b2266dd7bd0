"""What an iteration on several processes exchanges, so that all take the same step.

Every process holds the whole model, the photos and the error maps, and draws the samples of all K views: draws are a
function of (seed, iteration, place), so all draw the same. Then

1. each renders its share of the samples (`shares`), and the colours of all are gathered (12 bytes a sample). So loss,
   error maps and non-finite counts are those of one process, on each;
2. each back-propagates its share to the screen. The Gaussians are owned by the processes in equal runs of rows. An
   owner is sent the records of its rows in all views (72 bytes a Gaussian and view). Where a view has several shares,
   it adds up their records, in the order of the shares;
3. it solves for their update, and the new parameters of all rows are gathered (236 bytes a Gaussian).

Two processes with a small batch (`owners_pay`) that send messages do without 3: both get all records, and both make
all steps.

On GPUs of one host that are linked, all three are done in place: a process reads the others' memory (`in_place`), of
the records only those of Gaussians on screen, and its step writes to the others' models (`shared_model`). Elsewhere
colours and parameters are gathered and records sent as messages. Both ways give the same, to the bit.

Every step and statistic is computed by one process, as by a process alone, and copied to the others; or by all, from
the same records. So the replicas are bit-equal, and a step differs from that of one process only by the order in which
the samples of a view are added up. Moments and statistics of owned rows are valid for a process's own rows alone, until
`complete`. A density control that reads the statistics at every iteration (`DensityController.watched`) has them
gathered, without a host that waits.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.distributed.digest import digest
from turbogs_plugin.distributed.in_place import InPlace
from turbogs_plugin.distributed.ranks import ProcessRanks, Ranks
from turbogs_plugin.distributed.rows import OwnedRows, Packing, RowGather, rows_of
from turbogs_plugin.distributed.shared_model import SharedModel
from turbogs_plugin.distributed.shared_pass import Batch, SharedRendered, SharedScreen
from turbogs_plugin.distributed.shares import Share, shares_of
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.rendered import Rendered, RenderOptions, ScreenGradients
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, PixelSamples, RowUpdate, Step

LAG = 4
"""After so many iterations all processes look at the flags of an iteration, and wait for them if need be: so all know
of them at the same place, and no host runs farther ahead of its GPU."""

OWNERS_FROM = 4_000_000
"""Rows of a batch, views times Gaussians, from which on two processes that send messages gain by owners of rows.
Measured with .45, 1.5, 1.8 and 6 million (docs/scaling.md): below, two exchanges more cost what they save. In place
there is one exchange more, a barrier, and owners always gain."""

OVERFLOW, STOP = 0, 1
"""Columns of a pass's flags: iterations do nothing for lack of memory; the signal to stop, 0 for none. In messages they
travel as one more row of the colours, whose third number means nothing."""


class Exchange:
    """A process alone: every call goes to the engine, and nothing is exchanged."""

    def place(self, gaussians: Gaussians) -> Gaussians:
        """The model where iterations may change it: the given one, or a copy. Every process must call this."""
        return gaussians

    def render(
        self, engine: Engine, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions
    ) -> Rendered:
        """`Engine.render` of all K views."""
        return engine.render(gaussians, cameras, samples, options)

    def update(
        self,
        engine: Engine,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        """`Engine.update`."""
        engine.update(rule, screen, gaussians, moments, stats)

    def settle(self, engine: Engine, wait: bool = False) -> int:
        """`Engine.settle`."""
        return engine.settle(wait)

    def initial_errors(
        self, pixels: Sequence[int], errors_of: Callable[[int], Tensor], device: torch.device
    ) -> Iterator[Tensor]:
        """Errors [pixels] of one training view after the other.

        Args:
            pixels: of each view.
            errors_of: renders a view.
            device: where the errors are.
        """
        return map(errors_of, range(len(pixels)))

    def refine(
        self, density: DensityController, gaussians: Gaussians, step: Step, complete: Callable[[], None]
    ) -> RowUpdate | None:
        """The change that density control proposes.

        Args:
            gaussians: the model, which need not be complete yet.
            complete: makes moments and statistics complete.
        """
        return density.update(gaussians, step)

    def finish(self) -> None:
        """Wait, on the device, for the parameters of the latest `update`. Call it before they are used."""

    def complete(self, moments: GaussianMoments | None, stats: GaussianStats | None) -> None:
        """Make moments and statistics valid for all rows."""

    def compare(self, state: Callable[[], dict[str, Any]], iteration: int) -> None:
        """Raise `TrainingStopped` if a tensor or a number of a state differs between processes.

        Args:
            state: gives it, flat: name -> value. Whole, see `complete`.
            iteration: of the message.
        """


def exchange_of(ranks: Ranks) -> Exchange:
    """The exchange of these processes."""
    return RankExchange(ranks) if isinstance(ranks, ProcessRanks) else Exchange()


def owners_pay(processes: int, views: int, gaussians: int, in_place: bool = False) -> bool:
    """Whether owners of rows should make the steps of a batch, and not all processes all of them."""
    return in_place or processes > 2 or views * gaussians >= OWNERS_FROM


class RankExchange(Exchange):
    """Exchanges by torch.distributed, as the module says.

    Attributes:
        by_rows: owners of rows make the steps; None: where `owners_pay`. It may change when moments are complete.
            Optimizers without a rule always get all records, on every process.
        in_place: read the others' memory in place, if that is possible. It may change between two iterations, on all
            processes alike.
    """

    def __init__(self, ranks: ProcessRanks) -> None:
        self.ranks = ranks
        self.by_rows: bool | None = None
        self.in_place = True
        self.memory, self.model = InPlace(ranks), SharedModel(ranks)
        self._passes = 0
        self._flags: deque[_Flags] = deque()
        self._incomplete = False
        self._lent = False  # the engine uses `memory`
        self._owned: OwnedRows | None = None
        self._seen: Tensor | None = None  # [2] the flags of the latest pass
        self._buffers: list[tuple[Tensor, torch.cuda.Event]] = []  # for flags
        self._skipped: Tensor | None = None  # [] of all processes, when last complete

    def place(self, gaussians: Gaussians) -> Gaussians:
        self.memory.reserve(gaussians.device)
        return self.model.place(gaussians)

    def render(
        self, engine: Engine, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions
    ) -> SharedRendered:
        shares = shares_of(samples, self.ranks.count)
        own = shares[self.ranks.rank]
        memory = self._prepared(engine, shares, gaussians)
        rendered = None
        if len(own):
            part = cameras.select(range(own.views.start, own.views.stop))
            chosen = samples.of_tiles(own.tiles, own.views, own.slots)
            rendered = engine.render(gaussians, part, chosen, options)
        colors = self._gather_colors(engine, rendered, shares, gaussians.means, memory)
        batch = Batch(self.ranks, engine, gaussians, cameras, samples, options, shares, memory)
        return SharedRendered(colors, batch, rendered)

    @property
    def way(self) -> str:
        """How colours and records went in the latest pass."""
        return "in place" if self._lent else "messages"

    def _prepared(self, engine: Engine, shares: Sequence[Share], gaussians: Gaussians) -> InPlace | None:
        """The memory that this pass is exchanged in; None: by messages."""
        if self.in_place and self.memory.prepare(engine, shares, len(gaussians), gaussians.device):
            self._lent = True
            return self.memory
        if self._lent:
            engine.lend(None)
        self._lent = False
        return None

    def _gather_colors(
        self,
        engine: Engine,
        rendered: Rendered | None,
        shares: Sequence[Share],
        like: Tensor,
        memory: InPlace | None,
    ) -> Tensor:
        """[P, 3] of all samples; and all processes learn whether one had too little memory or wants to stop."""
        own = None if rendered is None else rendered.colors
        if self._seen is None or self._seen.device != like.device:
            self._seen = torch.zeros(2, dtype=torch.int32, device=like.device)
        if memory is None:
            colors = self._sent_colors(engine, own, shares, like)
        else:
            colors = memory.colors(engine, shares, own, self.ranks.asked, self._seen)
        self._flags.append(self._sent_flags(self._seen))
        self._passes += 1
        self.ranks.latest = time.monotonic()
        return colors

    def _sent_colors(self, engine: Engine, own: Tensor | None, shares: Sequence[Share], like: Tensor) -> Tensor:
        """[P, 3] the colours of all samples, by a message to all; sets `_seen` and the engine's own flag."""
        counts = [share.num_slots for share in shares]
        most = max(counts)
        sent = like.new_zeros(most + 1, 3)
        if own is not None:
            sent[: len(own)] = own
        if engine.overflow is not None:
            sent[most, OVERFLOW : OVERFLOW + 1].copy_(engine.overflow)
        if self.ranks.asked:
            sent[most, STOP] = self.ranks.asked
        gathered = self.ranks.gather(sent)  # [ranks, most + 1, 3]
        self._seen.copy_(gathered[:, most, :2].amax(dim=0))
        if engine.overflow is not None:
            engine.overflow.copy_(self._seen[:1])
        return torch.cat([colors[:count] for colors, count in zip(gathered, counts, strict=True)])

    def _sent_flags(self, flags: Tensor) -> _Flags:
        """`flags` [2] of this pass, on their way to the host."""
        if not flags.is_cuda:
            return _Flags(self._passes, flags.clone(), None)
        if not self._buffers:  # more than are ever under way
            pinned = [torch.empty_like(flags, device="cpu", pin_memory=True) for _ in range(2 * LAG)]
            self._buffers = [(values, torch.cuda.Event()) for values in pinned]
        values, event = self._buffers[self._passes % len(self._buffers)]
        values.copy_(flags, non_blocking=True)
        event.record(torch.cuda.current_stream(flags.device))
        return _Flags(self._passes, values, event)

    def settle(self, engine: Engine, wait: bool = False) -> int:
        while self._flags and (wait or self._flags[0].number <= self._passes - LAG):
            flags = self._flags.popleft()
            overflow, stop = flags.read()
            self.ranks.stop_signal = max(self.ranks.stop_signal, stop)
            if overflow:
                self._flags.clear()
                engine.recover()
                return self._passes - flags.number
        return 0

    def update(
        self,
        engine: Engine,
        rule: UpdateRule,
        screen: SharedScreen,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        if not self._incomplete:
            by_rows = self.by_rows
            if by_rows is None:
                by_rows = owners_pay(self.ranks.count, screen.views, len(gaussians), self._lent)
            if not by_rows:
                engine.update(rule, screen.whole(), gaussians, moments, stats)
                return
            self._incomplete, self._skipped = True, moments.skipped.clone()
        if self._owned is None or not self._owned.fits(gaussians, moments, stats):
            self._owned = OwnedRows(self.ranks, gaussians, moments, stats, self.model.others(gaussians))
        owned = self._owned
        copies = owned.copies if self._lent else None
        own_screen = screen.of_rows(owned.rows, owned.gaussians)
        if len(owned.gaussians):
            engine.update(rule, own_screen, owned.gaussians, owned.moments, owned.stats, copies)
        if copies is not None:
            self.memory.stepped()
        else:
            owned.begin()
            self.memory.ordered()

    def initial_errors(
        self, pixels: Sequence[int], errors_of: Callable[[int], Tensor], device: torch.device
    ) -> Iterator[Tensor]:
        for start in range(0, len(pixels), self.ranks.count):
            group = range(start, min(start + self.ranks.count, len(pixels)))
            own = errors_of(group[self.ranks.rank]) if self.ranks.rank < len(group) else None
            for source, view in enumerate(group):
                errors = own if source == self.ranks.rank else torch.empty(pixels[view], device=device)
                self.ranks.broadcast(errors, source)
                yield errors

    def refine(
        self, density: DensityController, gaussians: Gaussians, step: Step, complete: Callable[[], None]
    ) -> RowUpdate | None:
        if density.event_due(step):
            self.finish()
            complete()
            return self._agreed(density.update(gaussians, step))
        if "model" in density.watched:
            self.finish()
        if "statistics" in density.watched and self._incomplete and density.stats is not None:
            self._owned.gather_statistics()
        return density.update(gaussians, step)

    def _agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        """The first process's change. All make one, which advances the state of their density control."""
        plain = None
        if update is not None and self.ranks.first:
            shapes = {name: value.shape for name, value in update.values.items()}
            counts = (update.num_cloned, update.num_split, update.num_pruned)
            plain = (len(update.source), shapes, update.reset, counts, update.source.device.type)
        plain = self.ranks.agree(plain)
        if plain is None:
            return None
        count, shapes, reset, counts, device = plain
        if self.ranks.first:
            source, fresh, values = update.source, update.fresh.to(torch.uint8), update.values
        else:
            source = torch.empty(count, dtype=torch.int64, device=device)
            fresh = torch.empty(count, dtype=torch.uint8, device=device)
            values = {name: torch.empty(shape, device=device) for name, shape in shapes.items()}
        values = {name: value.contiguous() for name, value in values.items()}
        for tensor in (source, fresh, *values.values()):
            self.ranks.broadcast(tensor)
        return RowUpdate(source, fresh.bool(), values, reset, *counts)

    def complete(self, moments: GaussianMoments | None, stats: GaussianStats | None) -> None:
        if not self._incomplete or moments is None:
            return
        self._incomplete = False
        self.finish()
        self._owned = None  # an event makes new tensors, beside which the old ones have no room
        tensors = [moments.exp_avg, moments.exp_avg_sq, moments.exp_avg_shN, moments.exp_avg_sq_shN, moments.steps]
        tensors += [] if stats is None else list(vars(stats).values())
        gather = RowGather(self.ranks, Packing(tensors, rows_of(len(moments), self.ranks.count)))
        gather.begin()
        gather.finish()
        before = int(self._skipped)
        skipped = self.ranks.gather_numbers([int(moments.skipped) - before])
        moments.skipped.fill_(before + sum(own for (own,) in skipped))

    def finish(self) -> None:
        if self._owned is not None and self._owned.under_way:
            self._owned.finish()

    def compare(self, state: Callable[[], dict[str, Any]], iteration: int) -> None:
        plain = {name: value for name, value in state().items() if isinstance(value, (Tensor, int, float))}
        plain = {
            name: torch.tensor(value, dtype=torch.float64) if isinstance(value, float) else torch.as_tensor(value)
            for name, value in plain.items()
        }
        digests = self.ranks.gather_numbers([digest(value) for value in plain.values()])
        for name, *values in zip(plain, *digests, strict=True):
            others = [rank for rank, value in enumerate(values) if value != values[0]]
            if others:
                raise TrainingStopped(
                    f"iteration {iteration}: {name} of rank {others[0]} differs from that of rank 0, though all make "
                    "the same steps; do the GPUs and their software differ, or is one broken?"
                )


@dataclass
class _Flags:
    """Flags of a pass on their way to the host, [2] as `OVERFLOW` and `STOP` say."""

    number: int
    values: Tensor
    event: torch.cuda.Event | None

    def read(self) -> tuple[bool, int]:
        """(whether there was too little memory, the signal to stop). Waits until they have arrived."""
        if self.event is not None:
            self.event.synchronize()
        values = self.values.tolist()
        return values[OVERFLOW] != 0, int(values[STOP])
