"""A forward and a backward pass that several processes make together, each of its share of the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.distributed.in_place import InPlace
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.render_pass import (
    Projected,
    Rendered,
    RenderOptions,
    ScreenGradients,
    ScreenRecords,
    Upstream,
)
from turbogs_plugin.engine.shared import SharedEngine
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples


@dataclass
class Batch:
    """What the processes render together in a step, and which share of the samples each has.

    Args:
        engine: this process's.
        memory: in which all read the records; None: they are sent.
    """

    ranks: ProcessRanks
    engine: SharedEngine
    gaussians: Gaussians
    cameras: Cameras
    samples: PixelSamples
    options: RenderOptions
    shares: list[Share]
    memory: InPlace | None = None


@dataclass
class SharedRendered(Rendered):
    """One forward pass of several processes: `colors` are of all samples, `alphas` [0] and `depths` are not shared."""

    _batch: Batch
    _rendered: Rendered | None  # this process's share; None: it has no samples

    def projected(self) -> Projected:
        raise NotImplementedError("the projection of all views is on no single process")

    def _backward(self, upstream: Upstream, with_statistics: bool) -> SharedScreen:
        """Back-propagate this process's views to the screen."""
        plain = None
        if self._rendered is not None:
            slots = self._batch.shares[self._batch.ranks.rank].slots
            if upstream.alpha_gradients is not None or upstream.depth_gradients is not None:
                raise NotImplementedError("several processes train by gradients of colors alone")
            errors = None if upstream.pixel_errors is None else upstream.pixel_errors[slots]
            own = self._rendered.backward(upstream.color_gradients[slots], errors, with_statistics=with_statistics)
            plain = own.plain()
        return SharedScreen(self._batch, plain, with_statistics)


@dataclass
class SharedScreen:
    """Gradients on the screen (`ScreenGradients`), each view's on the process that rendered it."""

    _batch: Batch
    _plain: ScreenRecords | None
    _with_statistics: bool

    @property
    def views(self) -> int:
        """K, of all processes."""
        return len(self._batch.samples.view_ids)

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        """`ScreenGradients.parameter_gradients`, of all views and Gaussians, on every process."""
        whole = self.whole()
        if self._batch.memory is not None:  # no step in place follows, which would keep the next pass behind this
            self._batch.memory.stepped()
        return whole.parameter_gradients(rows, stats)

    def full_records(self) -> Tensor:
        return self.whole().full_records()

    def plain(self) -> ScreenRecords:
        return self.whole().plain()

    def whole(self) -> ScreenGradients:
        """Gradients of all views and Gaussians."""
        gaussians = self._batch.gaussians
        return self.of_rows([slice(0, len(gaussians))] * self._batch.ranks.count, gaussians)

    def of_rows(self, rows: Sequence[slice], own: Gaussians) -> ScreenGradients:
        """Gradients of all views, for some rows.

        Args:
            rows: what each process wants.
            own: the Gaussians of this process's rows.
        """
        batch, device = self._batch, own.device
        records = torch.empty(self.views, len(own), ScreenRecord.SIZE, device=device)
        radii = torch.empty(self.views, len(own), 2, dtype=torch.int32, device=device)
        target = ScreenRecords(records, radii, self._with_statistics)
        if batch.memory is None:
            self._send_and_receive(rows, target)
        else:
            count, first = len(batch.gaussians), rows[batch.ranks.rank].start
            batch.memory.collect(batch.engine, batch.shares, count, self._plain, target, first)
        return batch.engine.screen_gradients(own, batch.cameras, batch.samples, batch.options, target)

    def _send_and_receive(self, rows: Sequence[slice], target: ScreenRecords) -> None:
        """Send every process the records of the rows that it wants. `target`: of all views and this process's rows."""
        ranks, shares, records, radii = self._batch.ranks, self._batch.shares, target.records, target.radii
        mine = rows[ranks.rank]
        sent: list[tuple[int, Tensor]] = []
        received: list[tuple[int, Tensor]] = []
        continued: list[tuple[int, Tensor]] = []  # (view, records of a later share), to be added in this order
        for rank, share in enumerate(shares):
            if share.continues:
                continued.append((share.views.start, torch.empty_like(records[0])))
            if rank != ranks.rank:
                received += [(rank, records[share.begun]), (rank, radii[share.begun])]
                received += [(rank, continued[-1][1])] if share.continues else []
        if self._plain is not None:
            share, plain = shares[ranks.rank], self._plain
            first = int(share.continues)
            for rank, part in enumerate(rows):
                if rank != ranks.rank:
                    pieces = [plain.records[first:, part], plain.radii[first:, part], plain.records[:first, part]]
                    sent += [(rank, piece.contiguous()) for piece in pieces]
            records[share.begun], radii[share.begun] = plain.records[first:, mine], plain.radii[first:, mine]
            if share.continues:
                place = sum(other.continues for other in shares[: ranks.rank])
                continued[place][1].copy_(plain.records[0, mine])
        ranks.send_and_receive(sent, received)
        for view, later in continued:
            records[view] += later
