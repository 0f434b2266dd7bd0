"""Memory of the CUDA rasterizer, kept from one pass to the next, so that no pass waits for the GPU.

Only the GPU knows how many intersections of tiles and splats a pass has. A `Workspace` gives every pass memory for as
many as earlier passes suggest. Each pass sends its true count to the host without waiting, and later passes check
whether it has arrived. If a count exceeds the memory, the kernels set an overflow flag on the device. That pass and all
later ones draw nothing and change nothing, until the host learns of it, enlarges the memory and clears the flag
(`Workspace.take_lost`). So a splat is never dropped silently. The caller repeats the lost passes; in training
`Trainer.repeat_lost` does so, except for those before a change of the set of Gaussians.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import INTERSECTIONS_MAX, PassStatus
from turbogs_plugin.engine.shared import PassMemory
from turbogs_plugin.errors import InputError

Kept = TypeVar("Kept")

GROWTH = 1.25
"""A buffer that must grow gets this factor of the size asked for."""

MARGIN, EARLY_MARGIN, EARLY_PASSES = 1.15, 1.5, 32
"""Memory for intersections over the largest number expected: in general; in the first passes; how many these are."""

FORGETTING = 0.998
"""Factor of the largest count per tile at each pass, so that a rare peak does not cost sorting for ever."""

CAPACITY_STEP = 1 << 14
"""Capacities are multiples of this, so that sizes of scratch memory can be remembered."""

MAX_CAPACITY = INTERSECTIONS_MAX // CAPACITY_STEP * CAPACITY_STEP
"""The largest capacity. A count of `INTERSECTIONS_MAX` exceeds it, so it sets the flag."""

LENT = ("colors", "radii", "records")
"""Buffers that may lie in memory of the caller, by `Workspace.lend`."""

PENDING_MAX = 8
"""Most counts on their way to the host; one more waits for the oldest."""

ZEROS_AT_ONCE = 64
"""Zeros made together for `Workspace.zero`."""


def round_capacity(intersections: float) -> int:
    """The capacity for this many intersections."""
    return CAPACITY_STEP * max(1, math.ceil(intersections / CAPACITY_STEP))


def require_possible(intersections: int) -> None:
    """Raise `InputError` for a pass of more intersections than one can have: no memory would suffice."""
    if intersections > MAX_CAPACITY:
        most = f"at most {MAX_CAPACITY} intersections of tiles and splats"
        raise InputError(f"a pass takes {most}: take fewer views or tiles")


@dataclass
class _Pending:
    """A count on its way to the host: of pass `number`, with `tiles` active tiles. `event` says when it has arrived."""

    number: int
    tiles: int
    event: torch.cuda.Event
    values: Tensor  # [2] int32, pinned: intersections, overflow flag


class Workspace:
    """Buffers of one training run on one device and one stream. Their content is valid until the next pass.

    Args:
        device: a CUDA device.

    Attributes:
        status: [2] int32 on the device, of `layout.PassStatus`: intersections of the latest pass; the overflow flag.
        overflow: [1] int32 of `status`, not 0 while passes do nothing. Kernels that change state must check it.
        passes: number of passes begun.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self._set_status(torch.zeros(2, dtype=torch.int32, device=self.device))
        self.passes = 0
        self._buffers: dict[str, Tensor] = {}
        self._lent: PassMemory | None = None
        self._views: dict[str, Tensor] = {}  # what `buffer` returned last
        self._kept: dict[str, tuple[tuple, Any]] = {}
        self._zeros: list[Tensor] = []  # those that `zero` has not given away
        self._pinned = torch.zeros(PENDING_MAX, 2, dtype=torch.int32).pin_memory().unbind()
        self._events: dict[int, torch.cuda.Event] = {}  # by place in `_pinned`
        self._pending: deque[_Pending] = deque()
        self._gaussians = 0
        self._intersections_per_tile = 0.0
        self._first_lost: int | None = None

    def _set_status(self, status: Tensor) -> None:
        self.status, self.overflow = status, status[PassStatus.OVERFLOW :]

    def buffer(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """The buffer of this name, uninitialised; it grows if needed."""
        view = self._views.get(name)
        if view is not None and view.shape == shape and view.dtype == dtype:  # nearly always
            return view
        count = math.prod(shape)
        held = self._buffers.get(name)
        if held is None or held.numel() < count or held.dtype != dtype:
            self._views.pop(name, None)
            self._buffers.pop(name, None)  # freed before its successor is made
            held = self._buffers[name] = torch.empty(int(count * GROWTH) + 1, dtype=dtype, device=self.device)
        view = self._views[name] = held[:count].view(shape)
        return view

    def lend(self, memory: PassMemory | None) -> None:
        """Let the status and some buffers lie in memory of the caller, the buffers until they outgrow it; None: all are
        the workspace's own again. To be called before every pass that shall use it: a larger one may have replaced it.
        """
        lent = {} if memory is None else {name: getattr(memory, name) for name in LENT}
        if memory is self._lent and all(self._buffers.get(name) is value for name, value in lent.items()):
            return
        status = torch.empty_like(self.status) if memory is None else memory.status[: len(self.status)]
        self._set_status(status.copy_(self.status))
        self._kept.clear()  # holds views of buffers
        for name in LENT:
            self._views.pop(name, None)
            self._buffers.pop(name, None)
        self._buffers.update(lent)
        self._lent = memory

    def kept(self, name: str, sizes: tuple, make: Callable[[], Kept]) -> Kept:
        """Result of `make`, arguments of launches that are buffers of these `sizes`; made anew only where these differ
        from the last call of this name. To put them together takes the host as long as to enqueue the launches."""
        last = self._kept.get(name)
        if last is None or last[0] != sizes:
            self._kept.pop(name, None)  # lets go of the buffers that grow
            last = self._kept[name] = sizes, make()
        return last[1]

    def zero(self) -> Tensor:
        """[] float64 on the device, zero, which is the caller's alone. Many are made at once, as each launch that makes
        zeros takes the host 30 us."""
        if not self._zeros:
            self._zeros.extend(torch.zeros(ZEROS_AT_ONCE, dtype=torch.float64, device=self.device).unbind())
        return self._zeros.pop()

    def capacity(self, gaussians: int, tiles: int) -> int | None:
        """Number of intersections that a pass gets memory for, or None if nothing is known yet. Passes may go on after
        a loss, and draw nothing until `take_lost`: several processes agree on it some passes later."""
        if gaussians != self._gaussians:
            self._intersections_per_tile *= gaussians / self._gaussians if self._gaussians else 0.0
            self._gaussians = gaussians
        if self._intersections_per_tile == 0.0:
            return None
        margin = EARLY_MARGIN if self.passes < EARLY_PASSES else MARGIN
        return min(round_capacity(margin * self._intersections_per_tile * tiles), MAX_CAPACITY)

    def learn(self, intersections: int, tiles: int) -> None:
        """Take in the true count of a pass. Raises as `require_possible`."""
        require_possible(intersections)
        self._intersections_per_tile = max(self._intersections_per_tile * FORGETTING, intersections / max(1, tiles))

    def send_count(self, tiles: int) -> None:
        """Send the count of the pass just enqueued to the host, without waiting."""
        if len(self._pending) == PENDING_MAX:
            self.poll(wait_for=0)
        place = self.passes % PENDING_MAX
        if place not in self._events:
            self._events[place] = torch.cuda.Event()
        values, event = self._pinned[place], self._events[place]
        values.copy_(self.status, non_blocking=True)
        event.record(torch.cuda.current_stream(self.device))
        self._pending.append(_Pending(self.passes, tiles, event, values))
        self.passes += 1

    def poll(self, wait_for: int | None = None) -> None:
        """Take in the counts that have arrived; they do so in the order of the passes. Raises as `require_possible`.
        `wait_for`: place, among those under way, of a count to wait for."""
        if wait_for is not None and self._pending:
            self._pending[wait_for].event.synchronize()
        while self._pending and self._pending[0].event.query():
            arrived = self._pending.popleft()
            intersections, flag = arrived.values.tolist()
            if flag and self._first_lost is None:
                self._first_lost = arrived.number
            self.learn(intersections, arrived.tiles)

    def take_lost(self, wait: bool = False) -> int:
        """Number of the latest passes that did nothing and must be repeated. Clears the flag; the repetition will fit,
        or this raises as `require_possible`.

        Args:
            wait: wait for every count under way, as at the end of training; else only arrived ones are looked at.
        """
        self.poll(wait_for=-1 if wait else None)
        if self._first_lost is None:
            return 0
        lost = self.passes - self._first_lost
        # The counts still under way belong to lost passes; they are true, so the repetition will fit.
        self.poll(wait_for=-1)
        self._first_lost = None
        self.status.zero_()
        return lost
