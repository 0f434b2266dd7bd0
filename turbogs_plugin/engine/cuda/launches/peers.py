"""Launches that put together what several processes have rendered, in memory that all read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .base import Launch

if TYPE_CHECKING:
    from torch import Tensor


@dataclass
class Sources:
    """What each process with views has rendered, in their order: N Gaussians in V views, as `Splats` and records."""

    records_0: Tensor
    radii_0: Tensor
    records_1: Tensor | None
    radii_1: Tensor | None
    records_2: Tensor | None
    radii_2: Tensor | None
    records_3: Tensor | None
    radii_3: Tensor | None
    records_4: Tensor | None
    radii_4: Tensor | None
    records_5: Tensor | None
    radii_5: Tensor | None
    records_6: Tensor | None
    radii_6: Tensor | None
    records_7: Tensor | None
    radii_7: Tensor | None


@dataclass
class CollectRecords(Launch):
    """Copy the records of splats on screen from all processes' views to those of the batch, for a run of rows; and the
    radii. What several processes have of one view is added up.

    A source may be another GPU's memory, mapped here. M rows.
    """

    target_records: Tensor  # [K, M, 16] float32, layout.ScreenRecord; where off screen, left alone
    target_radii: Tensor  # [K, M, 2] int32
    sources: Sources
    first_views: list[int]  # [sources] of the batch; a process begins with the last view of the one before, or the next
    first_row: int  # of the sources


@dataclass
class Peers:
    """Memory of each process, rank after rank, [.] float32: this GPU's, and other GPUs' mapped here."""

    peer_0: Tensor
    peer_1: Tensor | None
    peer_2: Tensor | None
    peer_3: Tensor | None
    peer_4: Tensor | None
    peer_5: Tensor | None
    peer_6: Tensor | None
    peer_7: Tensor | None


@dataclass
class GatherColors(Launch):
    """Put the colours of all processes together, and look at their flags."""

    peers: Peers  # each begins with a layout.PassStatus, int32
    counts: list[int]  # [processes] samples of each
    first: int  # number at which colours begin, in each
    colors: Tensor  # [P, 3] float32
    seen: Tensor  # [2] int32: the largest of two flags
    overflow: Tensor | None  # [1] int32, set like the first of these
