"""Tables of the pixels of tiles, and `PixelSamples` from them. Plain index arithmetic, on any device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import TILE_SIZE, PixelSamples, TileGrid, sample_order

TILE_PIXELS = TILE_SIZE * TILE_SIZE


@dataclass(frozen=True)
class DrawEnds:
    """`PixelSamples.host_ends` of a draw whose sizes the host knows. Equal draws have equal ends.

    Args:
        unit: unit of the draw, one of `layout.SAMPLE_UNITS`.
        sizes: K times (width, height).
        wanted: K times the units drawn of a view's tiles, or of each of its tiles.
        live: K times the tiles that are drawn from, where these are not all tiles: each then has as many slots as a
            whole one.
    """

    unit: str
    sizes: tuple[tuple[int, int], ...]
    wanted: tuple[int, ...]
    live: tuple[int, ...] | None = None

    def __call__(self) -> tuple[np.ndarray, np.ndarray]:
        if self.unit == "tile":
            return np.cumsum(self.wanted), np.cumsum(np.full(sum(self.wanted), TILE_PIXELS))
        if self.live is not None:
            return np.cumsum(self.live), np.cumsum(np.full(sum(self.live), self.wanted[0]))
        sizes = np.array(self.sizes, dtype=np.int64)
        return np.array(TileGrid(sizes).starts[1:]), np.cumsum(np.minimum(self.wanted[0], tile_areas(sizes)))


def pixel_table(sizes: np.ndarray, device: torch.device | str, origin: tuple[int, int] = (0, 0)) -> Tensor:
    """[T, 256] int32: the pixel id of each place of each tile of ``TileGrid(sizes, origin)``, in `sample_order`; -1
    outside."""
    pixels = torch.arange(TILE_PIXELS, dtype=torch.int32, device=device)
    pixels = pixels[torch.argsort(sample_order(pixels % TILE_SIZE, pixels // TILE_SIZE))]
    x, y = pixels % TILE_SIZE, pixels // TILE_SIZE  # within the tile
    tables = []
    for width, height in sizes.tolist():
        starts_x, starts_y = (
            torch.arange(-start, side, TILE_SIZE, dtype=torch.int32, device=device)
            for start, side in zip(origin, (width, height), strict=True)
        )
        xs, ys = starts_x[:, None] + x, starts_y[:, None, None] + y  # [tiles in x, 256], [tiles in y, 1, 256]
        outside = (ys < 0) | (ys >= height) | (xs < 0) | (xs >= width)
        ids = (ys * width + xs).masked_fill_(outside, -1)
        tables.append(ids.reshape(-1, TILE_PIXELS))
    return torch.cat(tables)


def tile_areas(sizes: np.ndarray) -> np.ndarray:
    """[T] int64: pixels of each tile of ``TileGrid(sizes)`` that lie in its image."""
    areas = []
    for (width, height), (columns, rows) in zip(sizes, TileGrid(sizes).shapes, strict=True):
        widths = np.minimum(TILE_SIZE, width - TILE_SIZE * np.arange(columns))
        areas.append(np.outer(np.minimum(TILE_SIZE, height - TILE_SIZE * np.arange(rows)), widths).reshape(-1))
    return np.concatenate(areas)


def compact(
    view_ids: Sequence[int],
    sizes: np.ndarray,
    table: Tensor,
    mask: Tensor,
    tile_ids: Tensor,
    slot_counts: np.ndarray,
    weights: Tensor | None = None,
    full: bool = False,
    origin: tuple[int, int] = (0, 0),
) -> PixelSamples:
    """Samples of the masked places of tiles, in the table's order, without counting on the device.

    Args:
        view_ids, sizes, origin: the batch, as in `PixelSamples`.
        table: [T, 256] int32 pixel ids.
        mask: [T, 256] bool, the places to keep: in each tile at most its count of slots; the others stay empty.
        tile_ids: [T] int32.
        slot_counts: [T] int64, on the host.
        weights: [T, 256] float32 of the places, or None; they are divided by their mean over the filled slots.
        full: the mask fills every slot.
    """
    device = table.device
    offsets = np.concatenate([[0], np.cumsum(slot_counts)])
    slots = int(offsets[-1])
    tile_offsets = torch.as_tensor(offsets, dtype=torch.int32, device=device)
    positions = tile_offsets[:-1, None] + mask.cumsum(dim=1) - 1
    positions = torch.where(mask, positions, slots).reshape(-1)  # what is not kept goes behind the last slot
    pixel_ids = torch.full((slots + 1,), -1, dtype=torch.int32, device=device)
    pixel_ids[positions] = torch.where(mask, table, -1).reshape(-1)
    pixel_ids = pixel_ids[:-1]
    if weights is not None:
        kept = torch.zeros(slots + 1, device=device)
        kept[positions] = torch.where(mask, weights, 0.0).reshape(-1)
        weights = kept[:-1] * ((pixel_ids >= 0).sum() / kept[:-1].sum())
    return PixelSamples(
        tuple(view_ids), sizes, pixel_ids, tile_ids, tile_offsets, weights, has_empty_slots=not full, origin=origin
    )


def dense_pixels(view_ids: Sequence[int], sizes: np.ndarray, device: torch.device | str) -> PixelSamples:
    """Every pixel of these views, in the order of samples. `sizes`: [K, 2] int64 (width, height)."""
    pixel_ids, offsets = _dense(np.ascontiguousarray(sizes, dtype=np.int64).tobytes(), torch.device(device))
    tile_ids = torch.arange(len(offsets) - 1, dtype=torch.int32, device=device)
    ends = DrawEnds("pixel", tuple(map(tuple, sizes.tolist())), (TILE_PIXELS,) * len(sizes))
    return PixelSamples(tuple(view_ids), sizes, pixel_ids, tile_ids, offsets, None, False, ends)


@lru_cache(maxsize=16)
def _dense(sizes_bytes: bytes, device: torch.device) -> tuple[Tensor, Tensor]:
    """[P] int32 pixel ids and [T + 1] int32 first slots of each tile of dense views, whose [K, 2] int64 sizes are these
    bytes. Kept, as making them anew would let every iteration of a dense trainer wait for the device."""
    sizes = np.frombuffer(sizes_bytes, dtype=np.int64).reshape(-1, 2)
    table, slots = pixel_table(sizes, device), tile_areas(sizes)
    offsets = torch.as_tensor(np.concatenate([[0], np.cumsum(slots)]), dtype=torch.int32, device=device)
    return table[table >= 0], offsets
