"""Error maps and photos that live in host memory while a GPU trains (for captures that do not fit beside the model).

For every array over flat pixels the device has a *window*: slots, each as large as the largest view, for the views of
the present iteration and of the one before. The kernels see a flat array and the first pixel of each view, as always;
only these first pixels change from iteration to iteration. Results equal, bit for bit, those without a window.

Only the device waits for copies. There are two sets of slots: the views of an iteration are copied in while the device
still works on the iteration before, whose changed maps are copied out while the device works on this one. The order is:

- copy in: after the last work that used the slot, and after its old content has been copied out;
- copy out: after the work that changed the slot, as soon as the next views are asked for;
- work on a slot: after its view has been copied in.

What does not fit in host memory either lies in a file (`scene/host_arrays.py`): the disk reads the views of an
iteration all at once, and the host waits for them.
"""

from __future__ import annotations

import contextlib
import itertools
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.host_arrays import host_array, in_file, read_ahead
from turbogs_plugin.scene.photos import Photos, pixel_offsets

SETS = 2
"""Sets of slots: one that the device works on, one that travels."""

ABSENT = np.iinfo(np.int64).min // 2
"""Offset of a view that is not in the window: no index reaches from here into any array."""


class ViewWindow:
    """Arrays over the pixels of V views in host memory, and on a device the pixels of the views in use.

    Args:
        stores: arrays of one length [X, ...] in host memory. They are page-locked where they lie while the window
            exists, if there is a GPU to do that; without, and where they lie in files, copies are slower.
        sizes: [V, 2] int64 numpy array (width, height) of the views laid end to end in them.
        device: of the window. On a CPU, copies are made at once.
        written: the arrays are changed in the window, so views travel back as well.

    Attributes:
        offsets: [V] int64, first pixel of each view in `arrays`; `ABSENT` for a view that is not there.
    """

    def __init__(self, stores: Sequence[Tensor], sizes: np.ndarray, device: torch.device | str, written: bool) -> None:
        self.device = torch.device(device)
        self.written = written
        self.offsets = np.full(len(sizes), ABSENT, dtype=np.int64)
        self.stores = tuple(stores)
        self._starts = pixel_offsets(sizes)  # [V + 1]
        self._slot_pixels = int(sizes.prod(axis=1).max())
        self._used: set[int] = set()
        self._arrays: tuple[Tensor, ...] = ()
        self._inward, self._outward, self._computing = (_Stream(self.device, own) for own in (True, True, False))
        self._allocate(SETS)
        if self.device.type == "cuda":
            _page_lock(self)

    @property
    def arrays(self) -> tuple[Tensor, ...]:
        """The window, [slots * S + 1, ...] each with S pixels a slot and one more that belongs to no view.

        What is enqueued next on the current stream comes after the copies that `fetch` has begun.
        """
        self._computing.wait(self._arriving)
        self._arriving.clear()
        return self._arrays

    def fetch(self, view_ids: Sequence[int]) -> None:
        """Bring these views into the window, where they stay until the call after next that brings others."""
        wanted = set(view_ids)
        if wanted <= self._used:
            return
        if min(SETS * len(wanted), len(self.offsets)) > len(self._released):
            self.flush()
            self._allocate(SETS * len(wanted))
        self._release()
        self._used = wanted
        for view in wanted & self._slot_of.keys():
            # The latest in use come last. One on its way out may change meanwhile: it will travel once more.
            self._slot_of[view] = self._slot_of.pop(view)
        missing = [view for view in dict.fromkeys(view_ids) if view not in self._slot_of]
        slots = [self._free.pop() if self._free else self._evict() for _ in missing]
        self._inward.wait([*self._outward.latest, *(event for slot in slots for event in self._released[slot])])
        read_ahead([outside for view in missing for outside in self._outside(view)])
        for view, slot in zip(missing, slots, strict=True):
            self._slot_of[view] = slot
            self.offsets[view] = slot * self._slot_pixels
            for inside, outside in self._places(view):
                self._inward.copy(inside, outside)
        self._arriving += self._inward.mark()
        if self.written:
            self._write_back([view for view in list(self._slot_of)[: len(wanted)] if view not in wanted])
            self._changed |= wanted

    def flush(self) -> tuple[Tensor, ...]:
        """The whole arrays in host memory, up to date. Waits for the device."""
        self._release()
        self._write_back(list(self._changed))
        synchronize(self.device)
        return self.stores

    def change_all(self, index: int, function: Callable[[Tensor], Tensor]) -> None:
        """Replace every element of one array by a function of it, in the window as well."""
        used = self._used
        store = self.flush()[index]
        for start, end in itertools.pairwise(self._starts.tolist()):
            store[start:end] = function(store[start:end])
        self.arrays[index].copy_(function(self._arrays[index]))
        self._used = used
        self._changed |= used

    def load(self, values: Sequence[Tensor]) -> None:
        """Replace the whole arrays; the window is empty afterwards."""
        self.flush()
        for store, value in zip(self.stores, values, strict=True):
            store.copy_(value)
        self._allocate(len(self._released))

    def _allocate(self, slots: int) -> None:
        """An empty window."""
        slots = min(slots, len(self.offsets))
        self._arrays = ()  # freed before its successor is made
        self._arrays = tuple(
            torch.zeros(slots * self._slot_pixels + 1, *store.shape[1:], dtype=store.dtype, device=self.device)
            for store in self.stores
        )
        self.offsets[:] = ABSENT
        self._slot_of: dict[int, int] = {}  # of the views in the window, the latest in use last
        self._free = list(reversed(range(slots)))
        self._released = [self._computing.mark()] * slots  # of each slot: the end of the work that used it
        self._used = set()
        self._changed: set[int] = set()
        self._arriving: list[torch.cuda.Event] = []

    def _release(self) -> None:
        """Note that work enqueued so far is the last that uses the views in use."""
        now = self._computing.mark()
        for view in self._used:
            self._released[self._slot_of[view]] = now
        self._used = set()

    def _evict(self) -> int:
        """The slot of the view that was in use the longest ago."""
        view = next(iter(self._slot_of))
        self._write_back([view])
        self.offsets[view] = ABSENT
        return self._slot_of.pop(view)

    def _write_back(self, view_ids: Sequence[int]) -> None:
        """Let what has changed of these views, none of them in use, travel out."""
        if not (changed := [view for view in view_ids if view in self._changed]):
            return
        self._outward.wait([event for view in changed for event in self._released[self._slot_of[view]]])
        for view in changed:
            for inside, outside in self._places(view):
                self._outward.copy(outside, inside)
        self._outward.mark()
        self._changed.difference_update(changed)

    def _places(self, view: int) -> list[tuple[Tensor, Tensor]]:
        """(window, store) of one view, of each array."""
        first = int(self.offsets[view])
        both = zip(self._arrays, self._outside(view), strict=True)
        return [(array[first:][: len(outside)], outside) for array, outside in both]

    def _outside(self, view: int) -> list[Tensor]:
        """The part of each store that is one view's."""
        start, end = self._starts[view : view + 2].tolist()
        return [store[start:end] for store in self.stores]


class OffloadedPhotos(Photos):
    """Photos in host memory, with a window on a device; `colors` and `offsets` are the window's."""

    def __init__(self, photos: Photos, device: torch.device | str) -> None:
        self.sizes = photos.sizes
        self._window = ViewWindow((photos.stored.cpu(),), photos.sizes, device, written=False)
        self.offsets = self._window.offsets

    def fetch(self, view_ids: Sequence[int]) -> None:
        self._window.fetch(view_ids)

    @property
    def stored(self) -> Tensor:
        return self._window.stores[0]

    @property
    def colors(self) -> Tensor:  # type: ignore[override]  # read-only: the window's
        return self._window.arrays[0][:-1]

    def to(self, device: torch.device | str) -> OffloadedPhotos:
        return self if torch.device(device) == self._window.device else OffloadedPhotos(self, device)


class OffloadedErrorMaps(ErrorMaps):
    """Error maps in host memory, with a window on a device; `errors`, `stamps` and `offsets` are the window's."""

    @property
    def _arrays(self) -> tuple[Tensor, ...]:  # type: ignore[override]  # read-only: the window's
        return self._window.arrays

    def _allocate(self) -> None:
        pixels = int(self.sizes.prod(axis=1).sum())
        errors, stamps = (host_array((pixels,), dtype, "error maps") for dtype in (torch.float16, torch.int16))
        stores = (errors.zero_(), stamps.fill_(-1))
        self._window = ViewWindow(stores, self.sizes, self.device, written=True)
        self.offsets = self._window.offsets

    def fetch(self, view_ids: Sequence[int]) -> None:
        self._window.fetch(view_ids)

    def _copies(self) -> tuple[Tensor, Tensor]:
        """Maps in a file are given as they lie there, to be saved before training goes on: a copy may find no room."""
        errors, stamps = (store if in_file(store) else store.clone() for store in self._window.flush())
        return errors, stamps

    def _load(self, errors: Tensor, stamps: Tensor) -> None:
        self._window.load((errors, stamps))

    def _change_stamps(self, function: Callable[[Tensor], Tensor]) -> None:
        self._window.change_all(1, function)


def place_views(views: PosedImages, device: torch.device, place: str) -> PosedImages:
    """Views whose cameras are on the device, and their photos there or, for ``host``, in host memory with a window."""
    if place != "host":
        return views.to(device)
    return replace(views.with_cameras_on(device), photos=OffloadedPhotos(views.photos, device))


class _Stream:
    """Copies in one direction, on a stream of their `own` beside the computation; or the computation, on the current
    stream. On a CPU all is done at once, and there are no events. `latest` is the end of what was begun so far."""

    def __init__(self, device: torch.device, own: bool) -> None:
        self._device = device
        self._own = torch.cuda.Stream(device) if own and device.type == "cuda" else None
        self.latest: list[torch.cuda.Event] = []

    def wait(self, events: Sequence[torch.cuda.Event]) -> None:
        """What is enqueued from now on comes after these events."""
        for event in dict.fromkeys(events):
            (self._own or torch.cuda.current_stream(self._device)).wait_event(event)

    def copy(self, target: Tensor, source: Tensor) -> None:
        with torch.cuda.stream(self._own):  # which does nothing for None
            target.copy_(source, non_blocking=self._own is not None)

    def mark(self) -> list[torch.cuda.Event]:
        """The end of what is enqueued so far."""
        if self._device.type == "cuda":
            self.latest = [(self._own or torch.cuda.current_stream(self._device)).record_event()]
        return self.latest


def _page_lock(window: ViewWindow) -> None:
    """Lock the stores in memory, in place, until the window is gone: torch's own pinned memory would be a copy, rounded
    up to a power of two. Memory that another window has locked stays as that one has it. A file's is left alone:
    locked, all of it would have to be in memory."""
    runtime = torch.cuda.cudart()
    locked = []
    for store in window.stores:
        if in_file(store) or store.is_pinned():
            continue
        if int(runtime.cudaHostRegister(store.data_ptr(), store.nbytes, 0)) == 0:
            locked.append(store)
        else:  # a limit of the system: copies are slower; the runtime tells the error once more, to the next caller
            with contextlib.suppress(RuntimeError):
                torch.zeros(1, device=window.device)
    weakref.finalize(window, _unlock, locked, window.device)


def _unlock(stores: Sequence[Tensor], device: torch.device) -> None:
    synchronize(device)
    for store in stores:
        torch.cuda.cudart().cudaHostUnregister(store.data_ptr())
