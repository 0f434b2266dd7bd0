"""How the samples of an iteration are shared out: runs of tiles with equally many samples.

Runs end between two views where that is nearly even, and within a view where it is not. Then two processes, or more,
have a part of the view. So three views keep two processes equally busy, and one view does.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from turbogs_plugin.types import PixelSamples

NEARLY = 0.05
"""Largest difference from an even share, as a part of it, for the sake of ending with a view."""


@dataclass(frozen=True)
class Share:
    """The part of the samples that one process renders.

    Args:
        tiles, slots: of the samples.
        views: positions in the batch of the views that the tiles lie in; the first one may have begun in an earlier
            share.
    """

    tiles: slice
    slots: slice
    views: slice

    @property
    def num_slots(self) -> int:
        return self.slots.stop - self.slots.start

    def __len__(self) -> int:
        return self.views.stop - self.views.start


def shares_of(samples: PixelSamples, count: int) -> list[Share]:
    """The shares of `count` processes; one without samples has no views."""
    if samples.host_ends is None:
        return _cut(*samples.ends(), count)
    return _known(samples.host_ends, count)


@lru_cache(maxsize=256)
def _known(ends: Callable[[], tuple[np.ndarray, np.ndarray]], count: int) -> list[Share]:
    """`_cut`, whose results are kept: the draws of most iterations have equal sizes."""
    return _cut(*ends(), count)


def _cut(view_ends: np.ndarray, slot_ends: np.ndarray, count: int) -> list[Share]:
    """The shares of samples whose views end at these tiles, and whose tiles at these slots."""
    slots = np.concatenate([[0], slot_ends])  # [T + 1]
    views = np.concatenate([[0], view_ends])  # [K + 1]
    even = slots[-1] / count
    cuts = [0]
    for wanted in (place * even for place in range(1, count)):
        view = views[np.abs(slots[views] - wanted).argmin()]
        after = int(np.searchsorted(slots, wanted))
        before = max(0, after - 1)
        tile = before if wanted - slots[before] < slots[after] - wanted else after
        cuts.append(max(cuts[-1], int(view) if abs(slots[view] - wanted) <= NEARLY * even else tile))
    shares: list[Share] = []
    begun = 0  # views that earlier shares have begun
    cuts.append(len(slots) - 1)
    for first, end in itertools.pairwise(cuts):
        seen = slice(begun, begun)
        if first < end or (end == 0 and not shares):  # without any sample, the first process has all views
            start, stop = np.searchsorted(views, first, side="right") - 1, np.searchsorted(views, end, side="left")
            # Views without samples have records, too: those before the first tile, and behind the last one.
            seen = slice(min(int(start), begun), len(view_ends) if end == cuts[-1] else int(stop))
        shares.append(Share(slice(first, end), slice(int(slots[first]), int(slots[end])), seen))
        begun = max(begun, seen.stop)
    return shares
