"""A forward and a backward pass that several processes make together, each of its share of the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.distributed.in_place import InPlace, records_for
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.rendered import Rendered, RenderOptions, ScreenGradients, ScreenRecords
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples


@dataclass
class Batch:
    """What the processes render together in a step, and which share of the samples each has.

    Args:
        memory: in which all read the records; None: they are sent.
    """

    ranks: ProcessRanks
    engine: Engine
    gaussians: Gaussians
    cameras: Cameras
    samples: PixelSamples
    options: RenderOptions
    shares: list[Share]
    memory: InPlace | None = None


@dataclass
class SharedRendered:
    """One forward pass of several processes.

    Args:
        colors: [P, 3], of all samples.
    """

    colors: Tensor
    _batch: Batch
    _rendered: Rendered | None

    def backward(
        self, color_gradients: Tensor, pixel_errors: Tensor | None = None, *, with_statistics: bool = False
    ) -> SharedScreen:
        """Back-propagate this process's views to the screen. Arguments: of all samples, as in `Rendered.backward`."""
        plain = None
        if self._rendered is not None:
            slots = self._batch.shares[self._batch.ranks.rank].slots
            errors = None if pixel_errors is None else pixel_errors[slots]
            screen = self._rendered.backward(color_gradients[slots], errors, with_statistics=with_statistics)
            plain = screen.plain()
        return SharedScreen(self._batch, plain, with_statistics)


@dataclass
class SharedScreen:
    """Gradients on the screen, each view's on the process that rendered it."""

    _batch: Batch
    _plain: ScreenRecords | None
    _with_statistics: bool

    @property
    def views(self) -> int:
        """K, of all processes."""
        return len(self._batch.samples.view_ids)

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        """`ScreenGradients.parameter_gradients`, of all views and Gaussians, on every process."""
        return self.whole().parameter_gradients(rows, stats)

    def whole(self) -> ScreenGradients:
        """Of all views and Gaussians."""
        gaussians = self._batch.gaussians
        return self.of_rows([slice(0, len(gaussians))] * self._batch.ranks.count, gaussians)

    def of_rows(self, rows: Sequence[slice], own: Gaussians) -> ScreenGradients:
        """Of all views, for some rows.

        Args:
            rows: those that each process wants.
            own: the Gaussians of this process's rows.
        """
        batch, device = self._batch, own.device
        mine = rows[batch.ranks.rank]
        if batch.memory is None:
            target = records_for(self.views, mine.stop - mine.start, device, self._with_statistics)
            self._send_and_receive(rows, target)
        else:
            target = batch.memory.target(self.views, mine.stop - mine.start, device, self._with_statistics)
            count = len(batch.gaussians)
            batch.memory.collect(batch.engine, batch.shares, count, self._plain, target, mine.start)
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
