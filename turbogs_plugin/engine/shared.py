"""An engine on one device, with the defaults in torch, and what it offers to an engine of several GPUs around it.

A process renders its share of a batch; what its passes leave lies in memory that other processes read (`PassMemory`),
and its step may change their copies of the model too (`ModelCopies`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import PassStatus
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.render_pass import RenderOptions, ScreenGradients, ScreenRecords
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, PixelSamples


@dataclass
class PassMemory:
    """Memory of the caller, which others read, for what passes leave. Contiguous, aligned to 16 bytes.

    Args:
        status: [3] int32, `layout.PassStatus`.
        colors, radii, records: flat float32, int32 and float32, from whose start on a pass keeps as many as it has.
    """

    status: Tensor
    colors: Tensor
    radii: Tensor
    records: Tensor


@dataclass
class ModelCopies:
    """Copies of Gaussians, maybe in other devices' memory, that a step changes alike.

    Args:
        gaussians: the model that the step changes.
        copies: of the model. The parameters of a copy are as far from each other as the parameters of `gaussians`.
    """

    gaussians: Gaussians
    copies: Sequence[Gaussians]

    @cached_property
    def distances(self) -> tuple[int, ...]:
        """Bytes from the model to each copy: from every parameter to that parameter of the copy. Raises `InputError`: a
        copy lies otherwise."""
        filled = [(name, value) for name, value in self.gaussians.items() if value.numel()]
        found = [{getattr(copy, name).data_ptr() - value.data_ptr() for name, value in filled} for copy in self.copies]
        if any(len(each) != 1 for each in found):
            raise InputError("a copy of a model must lie as the model does: its parameters as far from each other")
        return tuple(distance for each in found for distance in each)


def collect_records(sources: Sequence[ScreenRecords], views: Sequence[int], target: ScreenRecords, row: int) -> None:
    """Collect the records of all K views for some rows. What several processes have of one view is added up, in
    their order.

    Args:
        sources: of V views and N Gaussians, of each process with views; maybe other devices' memory, read in place.
        views: first view of each, in the batch: the last one of the process before, or the next.
        target: of K views and M Gaussians; overwritten, but where off screen an engine may leave what is there.
        row: first of the M among the N.
    """
    rows, end = slice(row, row + target.records.shape[1]), 0
    for source, view in zip(sources, views, strict=True):
        if view < end:  # shared with the process before
            target.records[view] += source.records[0, rows]
        new, fresh = slice(end - view, None), slice(end, view + len(source.records))
        target.records[fresh], target.radii[fresh] = source.records[new, rows], source.radii[new, rows]
        end = fresh.stop


class SharedEngine(Engine):
    """An engine on one device, without what each engine does in its own way: draw, render, evaluate, go back from the
    screen (`screen_gradients`), and recover. Passes and steps can be put together with other engines' of its kind."""

    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
        copies: ModelCopies | None = None,
    ) -> None:
        """`Engine.update`. `copies`: of `gaussians`, to be changed alike."""
        apply_update(rule, gaussians, screen.parameter_gradients(rule.per_view, stats), moments)
        for copy in copies.copies if copies else ():
            for name, value in copy.items():
                value.copy_(getattr(gaussians, name))

    collect = staticmethod(collect_records)

    def lend(self, memory: PassMemory | None) -> bool:
        """Let the following passes keep in this memory what it is for, as far as it fits in; None: in the engine's own.
        Returns whether they do. False here: no memory is kept from pass to pass."""
        return False

    def gather(self, parts: Sequence[Tensor], first: int, counts: Sequence[int], seen: Tensor) -> Tensor:
        """[P, 3] float32: the colours of one process after the other's, valid until the next call. If one has set
        `PassStatus.OVERFLOW`, so does `overflow` here.

        Args:
            parts: [.] float32 of each process, memory that begins with the bits of its `PassStatus`; maybe other
                devices' memory, read in place.
            first: number at which its colours begin, in each.
            counts: samples of each.
            seen: [2] int32, written: the largest `PassStatus.OVERFLOW` of all, and the largest `PassStatus.STOP`.
        """
        statuses = torch.stack([part[: PassStatus.SIZE].view(torch.int32) for part in parts])  # [processes, 3]
        seen.copy_(statuses[:, PassStatus.OVERFLOW :].amax(dim=0))
        if self.overflow is not None:
            self.overflow.copy_(seen[:1])
        pieces = [part[first : first + 3 * count] for part, count in zip(parts, counts, strict=True)]
        return torch.cat(pieces).view(-1, 3)

    @abstractmethod
    def screen_gradients(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        samples: PixelSamples,
        options: RenderOptions,
        plain: ScreenRecords,
    ) -> ScreenGradients:
        """Screen gradients from plain tensors of K views and N Gaussians, which several passes of engines of this kind
        gave. `gaussians`: as they were rendered, all or rows of them; the others: as the passes had them together."""

    def recover(self) -> None:
        """Prepare to repeat iterations that were skipped because another process's memory was too small: wait for the
        device, learn what memory is needed, and clear `overflow`. Nothing here, where nothing is kept."""
