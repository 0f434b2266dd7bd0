"""An engine of several GPUs around the engine of each: all processes take the same step.

Every process holds the whole model, the photos and the error maps, and draws the samples of all K views: draws are a
function of (seed, iteration, place), so all draw the same. Then

1. each renders its share of the samples (`shares`), and the colours of all are gathered (12 bytes a sample). So each
   computes the loss, the error maps and the non-finite counts that one process alone would;
2. each back-propagates its share to the screen. The Gaussians are owned by the processes in equal runs of rows. An
   owner is sent the records of its rows in all views (72 bytes a Gaussian and view). Where a view has several shares,
   it adds up their records, in the order of the shares;
3. it solves for their update, and the new parameters of all rows are gathered (236 bytes a Gaussian).

Two processes with a small batch (`owners_pay`) that send messages do without 3: both get all records, and both make
all steps.

On GPUs of one host that are linked, all three are done in place: a process reads the others' memory (`in_place`), only
the records of Gaussians on screen, and its step writes to the others' models. Elsewhere colours and parameters are
gathered and records sent as messages. Both ways give the same, to the bit.

Every step and statistic is computed by one process, as by a process alone, and copied to the others; or by all, from
the same records. So the replicas are bit-equal, and a step differs from one process's step only by the order in which
the samples of a view are added up. Moments and statistics of owned rows are valid for a process's own rows alone, until
`complete`, which gathers statistics without a host that waits.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.distributed.in_place import InPlace, SharedModel
from turbogs_plugin.distributed.peer_memory import Sharing, share_memory
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.replicas import first_change, require_equal
from turbogs_plugin.distributed.rows import OwnedRows, RowGather, rows_of
from turbogs_plugin.distributed.shared_pass import Batch, SharedRendered, SharedScreen
from turbogs_plugin.distributed.shares import Share, shares_of
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS, RenderOptions, ScreenGradients
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.engine.shared import SharedEngine
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, PixelSamples, RowUpdate

LAG = 4
"""Passes after which all processes look at the flags of a pass, and wait for them if need be: so all know of them at
the same place, and no host runs farther ahead of its GPU."""

OWNERS_FROM = 4_000_000
"""Rows of a batch, views times Gaussians, from which on two processes that send messages gain by owners of rows.
Measured with .45, 1.5, 1.8 and 6 million (docs/scaling.md): below, two exchanges more cost what they save. In place
there is one exchange more, a barrier, and owners always gain."""

OVERFLOW, STOP = 0, 1
"""Columns of a pass's flags: iterations do nothing for lack of memory; the signal to stop, 0 for none. In messages they
travel as one more row of the colours, whose third number means nothing."""


def owners_pay(processes: int, views: int, gaussians: int) -> bool:
    """Whether owners of rows should make the steps of a batch that is sent as messages, not all processes all."""
    return processes > 2 or views * gaussians >= OWNERS_FROM


class RanksEngine:
    """`Engine` of several processes, as the module says.

    Args:
        engine: this process's, on `device`.
        share: gives memory that all processes read and write, or None.

    Attributes:
        in_place: read the others' memory in place, if that is possible. It may change between two iterations, on all
            processes alike.
    """

    def __init__(
        self, engine: SharedEngine, ranks: ProcessRanks, device: torch.device, share: Sharing = share_memory
    ) -> None:
        self.engine, self.ranks, self.device = engine, ranks, device
        self.draw, self.expose, self.learn_exposures = engine.draw, engine.expose, engine.learn_exposures
        self.evaluate, self.learn = engine.evaluate, engine.learn
        self.evaluate_and_learn, self.supervise = engine.evaluate_and_learn, engine.supervise
        self.in_place = True
        self.memory, self.model = InPlace(ranks, share), SharedModel(ranks, share)
        self._passes = 0
        self._flags: deque[_Flags] = deque()
        self._seen = torch.zeros(2, dtype=torch.int32, device=device)  # the flags of the latest pass
        self._buffers: list[tuple[Tensor, torch.cuda.Event]] = []  # for flags
        self._incomplete = False
        self._lent = False  # the engine uses `memory`
        self._owned: OwnedRows | None = None
        self._skipped: Tensor | int = 0  # [] updates that all processes skipped, when last complete

    @property
    def overflow(self) -> Tensor | None:
        return self.engine.overflow

    @property
    def bytes_held(self) -> int:
        return self.engine.bytes_held

    @property
    def way(self) -> str:
        """How colours and records went in the latest pass."""
        return "in place" if self._lent else "messages"

    def place(self, gaussians: Gaussians) -> Gaussians:
        self.memory.reserve(self.device)
        return self.model.place(gaussians)

    def render(
        self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
    ) -> SharedRendered:
        shares = shares_of(samples, self.ranks.count)
        own = shares[self.ranks.rank]
        lent = self.in_place and self.memory.prepare(self.engine, shares, len(gaussians), self.device)
        if self._lent and not lent:
            self.engine.lend(None)
        self._lent = lent
        rendered = None
        if len(own):
            part = cameras.select(range(own.views.start, own.views.stop))
            chosen = samples.of_tiles(own.tiles, own.views, own.slots)
            rendered = self.engine.render(gaussians, part, chosen, options)
        colors = self._gather_colors(None if rendered is None else rendered.colors, shares)
        memory = self.memory if lent else None
        batch = Batch(self.ranks, self.engine, gaussians, cameras, samples, options, shares, memory)
        return SharedRendered(colors, colors[:0, 0], None, batch, rendered)

    def _gather_colors(self, own: Tensor | None, shares: Sequence[Share]) -> Tensor:
        """[P, 3] of all samples; and all processes learn whether one had too little memory or wants to stop."""
        if self._lent:
            colors = self.memory.colors(self.engine, shares, own, self.ranks.asked, self._seen)
        else:
            colors = self._sent_colors(own, shares)
        self._flags.append(self._sent_flags())
        self._passes += 1
        self.ranks.latest = time.monotonic()
        return colors

    def _sent_colors(self, own: Tensor | None, shares: Sequence[Share]) -> Tensor:
        """[P, 3] the colours of all samples, by a message to all; sets `_seen` and the engine's own flag."""
        counts, overflow = [share.num_slots for share in shares], self.overflow
        most = max(counts)
        sent = torch.zeros(most + 1, 3, device=self.device)
        if own is not None:
            sent[: len(own)] = own
        if overflow is not None:
            sent[most, OVERFLOW : OVERFLOW + 1].copy_(overflow)
        if self.ranks.asked:
            sent[most, STOP] = self.ranks.asked
        gathered = self.ranks.gather(sent)  # [ranks, most + 1, 3]
        self._seen.copy_(gathered[:, most, :2].amax(dim=0))
        if overflow is not None:
            overflow.copy_(self._seen[:1])
        return torch.cat([colors[:count] for colors, count in zip(gathered, counts, strict=True)])

    def _sent_flags(self) -> _Flags:
        """The flags of this pass, on their way to the host."""
        if self.device.type != "cuda":
            return _Flags(self._passes, self._seen.clone(), None)
        if not self._buffers:  # more than are ever under way
            pinned = [torch.empty_like(self._seen, device="cpu", pin_memory=True) for _ in range(2 * LAG)]
            self._buffers = [(values, torch.cuda.Event()) for values in pinned]
        values, event = self._buffers[self._passes % len(self._buffers)]
        values.copy_(self._seen, non_blocking=True)
        event.record(torch.cuda.current_stream(self.device))
        return _Flags(self._passes, values, event)

    def settle(self, wait: bool = False) -> int:
        while self._flags and (wait or self._flags[0].number <= self._passes - LAG):
            flags = self._flags.popleft()
            overflow, stop = flags.read()
            self.ranks.stop_signal = max(self.ranks.stop_signal, stop)
            if overflow:
                self._flags.clear()
                self.engine.recover()
                return self._passes - flags.number
        return 0

    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        if not isinstance(screen, SharedScreen):
            raise TypeError(f"gradients of {type(screen).__name__} are not of a pass of several processes")
        if not self._incomplete:
            if not self._lent and not owners_pay(self.ranks.count, screen.views, len(gaussians)):
                self.engine.update(rule, screen.whole(), gaussians, moments, stats)
                return
            self._incomplete, self._skipped = True, moments.skipped.clone()
        if self._owned is None or not self._owned.fits(gaussians, moments, stats):
            self._owned = OwnedRows(self.ranks, gaussians, moments, stats, self.model.others(gaussians))
        owned = self._owned
        copies = owned.copies if self._lent else None
        own_screen = screen.of_rows(owned.rows, owned.gaussians)
        if len(owned.gaussians):
            self.engine.update(rule, own_screen, owned.gaussians, owned.moments, owned.stats, copies)
        if copies is not None:
            self.memory.stepped()
        else:
            owned.gather_parameters()

    def each_view(self, errors_of: Callable[[int], Tensor], pixels: Sequence[int]) -> Iterator[Tensor]:
        for start in range(0, len(pixels), self.ranks.count):
            group = range(start, min(start + self.ranks.count, len(pixels)))
            own = errors_of(group[self.ranks.rank]) if self.ranks.rank < len(group) else None
            for source, view in enumerate(group):
                errors = own if source == self.ranks.rank else None
                if errors is None:
                    errors = torch.empty(pixels[view], device=self.device)
                self.ranks.broadcast(errors, source)
                yield errors

    def complete(self, moments: GaussianMoments | None, stats: GaussianStats | None) -> None:
        if not self._incomplete or self._owned is None:
            return
        if moments is None:
            self._owned.gather_statistics()
            return
        self._incomplete = False
        self._owned = None  # an event makes new tensors, beside which the old ones have no room
        tensors = [moments.exp_avg, moments.exp_avg_sq, moments.exp_avg_shN, moments.exp_avg_sq_shN, moments.steps]
        tensors += [] if stats is None else list(vars(stats).values())
        RowGather(self.ranks, tensors, rows_of(len(moments), self.ranks.count))()
        before = int(self._skipped)
        skipped = self.ranks.gather_numbers([int(moments.skipped) - before])
        moments.skipped.fill_(before + sum(own for (own,) in skipped))

    def agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        """The first process's change. All propose one, which advances the state of their density control."""
        return first_change(self.ranks, update, self.device)

    def verify(self, state: Callable[[], dict[str, Any]]) -> None:
        require_equal(self.ranks, state())


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
