"""Memory of the CUDA rasterizer from one pass to the next, and how it does without waiting for the GPU.

The number of intersections of tiles and splats of a pass is known on the GPU only. A `Workspace` gives every pass room
for as many as earlier passes lead to expect. Each pass sends its true count to the host without waiting, and later
passes look whether it has come. Where a count exceeds its room, the kernels raise a flag on the device: that pass and
all that follow it draw nothing and change nothing, until the host learns of it, makes room and lowers the flag
(`Workspace.take_lost`). So a splat is never dropped silently. Whoever lost passes does them again; in training that is
`Trainer.repeat_lost`, which leaves out those before a change of the set of Gaussians.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import INTERSECTIONS_MAX
from turbogs_plugin.errors import InputError

GROWTH = 1.25
"""A buffer that must grow gets this much more than was asked for."""

MARGIN, EARLY_MARGIN, EARLY_PASSES = 1.15, 1.5, 32
"""Room for intersections over the largest number expected; the margin of the first passes, which know few views."""

FORGETTING = 0.998
"""What a pass leaves of the largest count per tile, so that a rare peak does not cost sorting for ever."""

CAPACITY_STEP = 1 << 14
"""Capacities are multiples of this, so that sizes of scratch memory can be remembered."""

MAX_CAPACITY = INTERSECTIONS_MAX // CAPACITY_STEP * CAPACITY_STEP
"""The largest capacity. A count of `INTERSECTIONS_MAX` is beyond it and therefore raises the flag."""

PENDING_MAX = 8
"""Counts under way; one more waits for the oldest."""


def round_capacity(intersections: float) -> int:
    """The capacity for this many intersections."""
    return CAPACITY_STEP * max(1, math.ceil(intersections / CAPACITY_STEP))


def require_possible(intersections: int) -> None:
    """Refuse a pass of more intersections than one can have.

    Raises:
        InputError: no memory would be room enough.
    """
    if intersections > MAX_CAPACITY:
        raise InputError(
            f"a pass takes at most {MAX_CAPACITY} intersections of tiles and splats: take fewer views or tiles"
        )


@dataclass
class _Pending:
    """A count under way: of which pass, with how many active tiles; where it arrives, and when."""

    number: int
    tiles: int
    event: torch.cuda.Event
    values: Tensor  # [2] int32, pinned: intersections, overflow flag


class Workspace:
    """Buffers of one training run on one device and one stream. What a pass left in them is valid until the next pass.

    Args:
        device: a CUDA device.

    Attributes:
        status: [2] int32 on the device: intersections of the latest pass; the overflow flag.
        passes: passes begun.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.status = torch.zeros(2, dtype=torch.int32, device=self.device)
        self.passes = 0
        self._buffers: dict[str, Tensor] = {}
        self._views: dict[str, Tensor] = {}  # what `buffer` returned last
        self._pinned = torch.zeros(PENDING_MAX, 2, dtype=torch.int32).pin_memory()
        self._pending: deque[_Pending] = deque()
        self._gaussians = 0
        self._intersections_per_tile = 0.0
        self._first_lost: int | None = None

    @property
    def overflow(self) -> Tensor:
        """[1] int32 on the device, not 0 while passes do nothing. Kernels that change state must look at it."""
        return self.status[1:]

    @property
    def overflowed(self) -> bool:
        """The host knows of a pass that did not fit."""
        return self._first_lost is not None

    def buffer(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Memory of this name, uninitialised; grown where needed."""
        view = self._views.get(name)
        if view is not None and view.shape == shape and view.dtype == dtype:  # nearly always; slicing takes 9 us
            return view
        count = math.prod(shape)
        held = self._buffers.get(name)
        if held is None or held.numel() < count or held.dtype != dtype:
            self._views.pop(name, None)
            self._buffers.pop(name, None)  # freed before its successor is made
            held = self._buffers[name] = torch.empty(int(count * GROWTH) + 1, dtype=dtype, device=self.device)
        view = self._views[name] = held[:count].view(shape)
        return view

    def bytes_held(self) -> int:
        """Memory of all buffers."""
        return sum(held.numel() * held.element_size() for held in self._buffers.values())

    def capacity(self, gaussians: int, tiles: int) -> int | None:
        """Room for the intersections of a pass, or None where nothing is known yet.

        Raises:
            RuntimeError: an overflow is known and `take_lost` has not been called.
        """
        if self.overflowed:
            raise RuntimeError("passes were lost to an overflow: call Workspace.take_lost() and repeat them")
        if gaussians != self._gaussians:
            self._intersections_per_tile *= gaussians / self._gaussians if self._gaussians else 0.0
            self._gaussians = gaussians
        if self._intersections_per_tile == 0.0:
            return None
        margin = EARLY_MARGIN if self.passes < EARLY_PASSES else MARGIN
        return min(round_capacity(margin * self._intersections_per_tile * tiles), MAX_CAPACITY)

    def learn(self, intersections: int, tiles: int) -> None:
        """Take in the true count of a pass.

        Raises:
            InputError: a pass cannot have that many.
        """
        require_possible(intersections)
        self._intersections_per_tile = max(self._intersections_per_tile * FORGETTING, intersections / max(1, tiles))

    def send_count(self, tiles: int) -> None:
        """Send the count of the pass just enqueued to the host, without waiting."""
        if len(self._pending) == PENDING_MAX:
            self._pending[0].event.synchronize()
            self.poll()
        values = self._pinned[self.passes % PENDING_MAX]
        values.copy_(self.status, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self.device))
        self._pending.append(_Pending(self.passes, tiles, event, values))
        self.passes += 1

    def poll(self) -> None:
        """Take in the counts that have arrived.

        Raises:
            InputError: a pass had more intersections than one can have; it drew nothing.
        """
        while self._pending and self._pending[0].event.query():
            arrived = self._pending.popleft()
            intersections, flag = arrived.values.tolist()
            if flag and self._first_lost is None:
                self._first_lost = arrived.number
            self.learn(intersections, arrived.tiles)

    def _wait(self) -> None:
        """Take in every count under way. They arrive in the order of the passes."""
        if self._pending:
            self._pending[-1].event.synchronize()
            self.poll()

    def take_lost(self, wait: bool = False) -> int:
        """Number of passes at the end that did nothing and must be done again; makes room for them and lowers the flag.

        Args:
            wait: for every count under way, as at the end of training; else only what has arrived is looked at.

        Raises:
            InputError: a pass had more intersections than one can have: repeating it is no use.
        """
        if wait:
            self._wait()
        self.poll()
        if self._first_lost is None:
            return 0
        lost = self.passes - self._first_lost
        # The counts still under way belong to lost passes; they are true, so the repetition will fit.
        self._wait()
        self._first_lost = None
        self.status.zero_()
        return lost
