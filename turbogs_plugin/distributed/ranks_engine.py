"""An engine of several GPUs around the engine of each: all processes take one step together.

Every process holds the whole model, the photos and the error maps, and draws the samples of all K views: draws are a
function of (seed, iteration, place), so the draws of all are equal. Then

1. each renders its share of the samples (`shares`), and the colours of all are gathered (12 bytes a sample). So each
   computes the loss, the error maps and the non-finite counts that one process alone would;
2. each back-propagates its share to the screen. The Gaussians are owned by the processes in equal runs of rows. An
   owner gets the records of its rows in all views (72 bytes a Gaussian and view). Where a view has several shares,
   it adds up their records, in the order of the shares;
3. it solves for their update, and the new parameters of all rows go to all processes (236 bytes a Gaussian).

On GPUs of one host that are linked, all three are done in place (`in_place`): a process reads the others' memory, only
the records of Gaussians on screen, and its step writes to the others' models. Elsewhere they are sent (`messages`).
Both ways give equal results, to the bit.

Every step and statistic is computed by one process, as by a process alone, and copied to the others; or by all, from
equal records. So the replicas are bit-equal, and a step differs from one process's step only by the order in which the
samples of a view are added up. Moments and statistics of owned rows are valid for a process's own rows alone, until
`complete`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import is_
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.distributed.in_place import InPlace
from turbogs_plugin.distributed.messages import Messages, gather_rows, rows_of
from turbogs_plugin.distributed.peer_memory import Sharing, share_memory
from turbogs_plugin.distributed.ranks import ProcessRanks, first_change, require_equal
from turbogs_plugin.distributed.shares import Share, shares_of
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.render_pass import (
    DEFAULT_OPTIONS,
    Projected,
    Rendered,
    RenderOptions,
    ScreenGradients,
    ScreenRecords,
    Upstream,
)
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.engine.shared import ModelCopies, SharedEngine
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples, RowUpdate

LAG = 4
"""Passes after which all processes look at the flags of a pass, and wait for them if need be: so all know of them at
one place, and no host runs farther ahead of its GPU."""

OWNERS_FROM = 4_000_000
"""Rows of a batch, views times Gaussians, from which on two processes that send messages gain by owners of rows.
Measured with .45, 1.5, 1.8 and 6 million: below, two exchanges more cost what they save. In place there is one barrier
more, and owners always gain."""


class RanksEngine:
    """`Engine` of several processes, as the module says.

    Args:
        engine: this process's, on `device`.
        share: gives memory that all processes read and write, or None.
    """

    def __init__(
        self, engine: SharedEngine, ranks: ProcessRanks, device: torch.device, share: Sharing = share_memory
    ) -> None:
        self.engine, self.ranks, self.device = engine, ranks, device
        self.draw, self.evaluate, self.learn = engine.draw, engine.evaluate, engine.learn
        self.expose, self.learn_exposures = engine.expose, engine.learn_exposures
        self.evaluate_and_learn, self.supervise = engine.evaluate_and_learn, engine.supervise
        self.memory, self.messages = InPlace(engine, ranks, share), Messages(engine, ranks)
        self._exchange: InPlace | Messages = self.messages  # of the latest pass
        self._passes = 0
        # The largest `PassStatus.OVERFLOW` and `PassStatus.STOP` of all, [2] int32: of the latest pass; and on the way
        # to the host, with the number of the pass and the event of the arrival.
        self._seen = torch.zeros(2, dtype=torch.int32, device=device)
        self._flags: deque[tuple[int, Tensor, torch.cuda.Event | None]] = deque()
        self._owned: OwnedRows | None = None  # whose moments and statistics are valid here; None: all rows
        self._skipped: Tensor | int = 0  # [] updates that all processes skipped, when last complete

    @property
    def overflow(self) -> Tensor | None:
        return self.engine.overflow

    def place(self, gaussians: Gaussians) -> Gaussians:
        self._owned = None
        return self.memory.place(gaussians)

    def render(
        self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
    ) -> SharedRendered:
        rank, shares = self.ranks.rank, shares_of(samples, self.ranks.count)
        own = shares[rank]
        placed = self.memory.others(gaussians) is not None
        if placed and self.memory.prepare(shares, len(gaussians), self.device):
            self._exchange = self.memory
        elif self._exchange is self.memory:
            self.engine.lend(None)
            self._exchange = self.messages
        rendered = None
        if len(own):
            part = cameras.select(range(own.views.start, own.views.stop))
            chosen = samples.of_tiles(own.tiles, own.views, own.slots)
            rendered = self.engine.render(gaussians, part, chosen, options)
        colors = self._exchange.colors(shares, None if rendered is None else rendered.colors, self._seen)
        flags = self._seen.to("cpu", non_blocking=True, copy=True)  # from a GPU into pinned memory
        event = torch.cuda.current_stream(self.device).record_event() if self._seen.is_cuda else None
        self._flags.append((self._passes, flags, event))
        self._passes += 1
        batch = Batch(rank, self.engine, self._exchange, gaussians, cameras, samples, options, shares)
        depths = torch.zeros(len(samples), device=self.device) if options.with_depth else None
        if depths is not None and rendered is not None and rendered.depths is not None:
            depths[own.slots] = rendered.depths
        return SharedRendered(colors, colors[:0, 0], depths, batch, rendered)

    def settle(self, wait: bool = False) -> int:
        while self._flags and (wait or self._flags[0][0] <= self._passes - LAG):
            number, flags, event = self._flags.popleft()
            if event is not None:
                event.synchronize()
            overflow, stop = flags.tolist()
            self.ranks.stop_signal = max(self.ranks.stop_signal, stop)
            if overflow:
                self._flags.clear()
                self.engine.recover()
                return self._passes - number
        return 0

    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        assert isinstance(screen, SharedScreen), "gradients are not of a pass of several processes"
        if self._owned is None:
            rows = len(screen.batch.samples.view_ids) * len(gaussians)
            if self._exchange is self.messages and self.ranks.count == 2 and rows < OWNERS_FROM:
                self.engine.update(rule, screen.whole(), gaussians, moments, stats)
                return
            self._skipped = moments.skipped.clone()
        if self._owned is None or not all(map(is_, self._owned.whole, (gaussians, moments, stats))):
            self._owned = OwnedRows(self.ranks, gaussians, moments, stats, self.memory.others(gaussians))
        owned = self._owned
        own_screen = screen.of_rows(owned.rows, owned.gaussians)
        if len(owned.gaussians):
            copies = owned.copies if self._exchange is self.memory else None
            self.engine.update(rule, own_screen, owned.gaussians, owned.moments, owned.stats, copies)
        self._exchange.stepped(gaussians)

    def complete(self) -> None:
        if self._owned is None:
            return
        _, moments, stats = self._owned.whole
        statistics = [] if stats is None else list(vars(stats).values())
        self._owned = None  # an event makes new tensors, beside which the old ones have no room
        tensors = [moments.exp_avg, moments.exp_avg_sq, moments.exp_avg_shN, moments.exp_avg_sq_shN, moments.steps]
        gather_rows(self.ranks, tensors + statistics)
        before = int(self._skipped)
        skipped = self.ranks.gather_numbers([int(moments.skipped) - before])
        moments.skipped.fill_(before + sum(own for (own,) in skipped))

    def agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        """The first process's change. All propose one, which advances the state of their density control."""
        return first_change(self.ranks, update, self.device)

    def verify(self, state: Callable[[], dict[str, Any]]) -> None:
        require_equal(self.ranks, state())


@dataclass
class Batch:
    """What the processes render together in a step, and which share of the samples each has."""

    rank: int
    engine: SharedEngine
    exchange: InPlace | Messages  # of colours and records
    gaussians: Gaussians
    cameras: Cameras
    samples: PixelSamples
    options: RenderOptions
    shares: list[Share]


@dataclass
class SharedRendered(Rendered):
    """One forward pass of several processes: `colors` are of all samples, `alphas` are not there, and `depths` are this
    process's alone, 0 for others': a depth term's gradient goes back where the depth came from."""

    batch: Batch
    _rendered: Rendered | None  # this process's share; None: it has no samples

    def projected(self) -> Projected:
        raise NotImplementedError("the projection of all views is on no single process")

    def _backward(self, upstream: Upstream, with_statistics: bool) -> SharedScreen:
        """Back-propagate this process's views to the screen."""
        plain = None
        if self._rendered is not None:
            slots = self.batch.shares[self.batch.rank].slots
            given = vars(upstream).items()
            own: dict[str, Any] = {name: None if value is None else value[slots] for name, value in given}
            plain = self._rendered.backward(**own, with_statistics=with_statistics).plain()
        return SharedScreen(self.batch, plain)


@dataclass
class SharedScreen(ScreenGradients):
    """Gradients on the screen, each view's on the process that rendered it."""

    batch: Batch
    _plain: ScreenRecords | None

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        whole = self.whole()
        self.batch.exchange.stepped()
        return whole.parameter_gradients(rows, stats)

    def plain(self) -> ScreenRecords:
        return self.whole().plain()

    def whole(self) -> ScreenGradients:
        """Gradients of all views and Gaussians."""
        gaussians = self.batch.gaussians
        return self.of_rows([slice(0, len(gaussians))] * len(self.batch.shares), gaussians)

    def of_rows(self, rows: Sequence[slice], own: Gaussians) -> ScreenGradients:
        """Gradients of all views, for the rows that each process wants. `own`: the Gaussians of this process's rows."""
        batch, shape = self.batch, (len(self.batch.samples.view_ids), len(own))
        records = torch.empty(*shape, ScreenRecord.SIZE, device=own.device)
        radii = torch.empty(*shape, 2, dtype=torch.int32, device=own.device)
        target = ScreenRecords(records, radii)
        batch.exchange.collect(batch.shares, rows, self._plain, target)
        return batch.engine.screen_gradients(own, batch.cameras, batch.samples, batch.options, target)


class OwnedRows:
    """What one process needs to make the step of its rows, as long as the tensors stay.

    Args:
        others: the model in the memory of each other process, to which a step in place writes as well; None: there is
            no such memory.

    Attributes:
        rows: each process's.
        gaussians, moments, stats, copies: of this process's rows, views of the tensors.
    """

    def __init__(
        self,
        ranks: ProcessRanks,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
        others: Sequence[Gaussians] | None,
    ) -> None:
        self.whole = gaussians, moments, stats
        self.rows = rows_of(len(gaussians), ranks.count)
        own = self.rows[ranks.rank]
        self.gaussians = gaussians.map(lambda value: value[own])
        states = vars(moments).items()
        self.moments = replace(moments, **{name: value[own] if value.dim() else value for name, value in states})
        self.stats = None if stats is None else stats.map(lambda value: value[own])
        self.copies: ModelCopies | None = None
        if others is not None:
            self.copies = ModelCopies(self.gaussians, [other.map(lambda value: value[own]) for other in others])
