"""Masks of the pixels that count in each view, as lists of the tiles that have a pixel left.

A *live* tile has at least one pixel that is not masked. Draws go over live tiles alone, so the others cost nothing. A
tile that the mask cuts has a bit for each of its pixels; all whole tiles share one row of bits. Masks take an eighth of
a byte a pixel or less, so they stay on the device even where photos and error maps do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.tiles import TILE_PIXELS, pixel_table, tile_areas
from turbogs_plugin.types import TILE_SIZE, PixelSamples, TileGrid

WORD_BITS = 32
WORDS = TILE_PIXELS // WORD_BITS
"""32-bit words of a tile's bits; bit n of word j is the pixel with `sample_order` 32 j + n."""

_PLACES = pixel_table(np.full((1, 2), TILE_SIZE), "cpu")[0].numpy()
"""[256] int32: the pixel, counted row by row, that each place of a tile in `sample_order` has."""


@dataclass(frozen=True, eq=False)
class PixelMasks:
    """The masks of V views.

    Args:
        sizes: [V, 2] int64 numpy array (width, height).
        offsets: [V + 1] int64 numpy array, the first live tile of each view, and the count L of all.
        pixel_counts: [V] int64 numpy array, pixels of each view that are not masked.
        tiles: [L] int32, number of each live tile within its view, ascending in each.
        rows: [L] int32, each live tile's row of `bits`; all whole tiles share row 0.
        bits: [B, WORDS] int32, see `WORDS`. Bits outside the image mean nothing.
    """

    sizes: np.ndarray
    offsets: np.ndarray
    pixel_counts: np.ndarray
    tiles: Tensor
    rows: Tensor
    bits: Tensor

    @classmethod
    def of(cls, keep: np.ndarray) -> PixelMasks:
        """The mask of one view, an image [H, W] in which True or nonzero pixels count; on the CPU."""
        height, width = keep.shape
        rows, columns = -(-height // TILE_SIZE), -(-width // TILE_SIZE)
        padded = np.zeros((rows * TILE_SIZE, columns * TILE_SIZE), dtype=bool)
        padded[:height, :width] = keep
        places = padded.reshape(rows, TILE_SIZE, columns, TILE_SIZE).swapaxes(1, 2).reshape(-1, TILE_PIXELS)
        counts, sizes = places.sum(axis=1), np.array([[width, height]], dtype=np.int64)
        live = np.flatnonzero(counts)
        cut = counts[live] < tile_areas(sizes)[live]  # [L] bool, the mask takes pixels of the tile
        packed = np.ascontiguousarray(np.packbits(places[live[cut]][:, _PLACES], axis=1, bitorder="little"))
        return cls(
            sizes=sizes,
            offsets=np.array([0, len(live)]),
            pixel_counts=counts.sum(keepdims=True),
            tiles=torch.from_numpy(live.astype(np.int32)),
            rows=torch.from_numpy(np.where(cut, np.cumsum(cut), 0).astype(np.int32)),
            bits=torch.from_numpy(np.concatenate([np.full((1, WORDS), -1, dtype=np.int32), packed.view("<i4")])),
        )

    @classmethod
    def joined(cls, views: Sequence[PixelMasks]) -> PixelMasks:
        """The masks of single views as the masks of all."""
        befores = np.cumsum([0, *(len(view.bits) - 1 for view in views)]).tolist()  # rows of cut tiles
        rows = [torch.where(view.rows > 0, view.rows + before, 0) for view, before in zip(views, befores, strict=False)]
        return cls(
            sizes=np.concatenate([view.sizes for view in views]),
            offsets=np.cumsum([0, *(len(view.tiles) for view in views)]),
            pixel_counts=np.concatenate([view.pixel_counts for view in views]),
            tiles=torch.cat([view.tiles for view in views]),
            rows=torch.cat(rows),
            bits=torch.cat([views[0].bits[:1], *(view.bits[1:] for view in views)]),
        )

    @classmethod
    def from_images(cls, masks: Tensor | Sequence[Tensor | np.ndarray]) -> PixelMasks:
        """Masks from images, on the CPU.

        Args:
            masks: [V, H, W] bool, or V images [H, W] whose sizes may differ. True (nonzero) pixels count.

        Raises:
            InputError: no image, one of another shape, or no pixel that counts in any.
        """
        if len(masks) == 0 or any(getattr(mask, "ndim", 0) != 2 for mask in masks):
            shapes = [tuple(getattr(mask, "shape", ())) for mask in masks][:4]
            raise InputError(f"masks have shapes {shapes}: expected [H, W] for each view, True where a pixel counts")
        joined = cls.joined([cls.of(torch.as_tensor(mask).cpu().numpy() != 0) for mask in masks])
        if not joined.pixel_counts.any():
            raise InputError("masks leave no pixel of any photo: they may be inverted; True is where a pixel counts")
        return joined

    def to(self, device: torch.device | str) -> PixelMasks:
        tensors = {name: getattr(self, name).to(device) for name in ("tiles", "rows", "bits")}
        return replace(self, **tensors)

    def live_counts(self, view_ids: Sequence[int]) -> list[int]:
        """Live tiles of each of these views."""
        return [int(self.offsets[view + 1] - self.offsets[view]) for view in view_ids]

    def live_tiles(self, view_ids: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The live tiles of a batch of views: [T] int64 their ids in ``TileGrid(sizes of these views)``, ascending; and
        [T, 256] bool, which of a tile's places (`sample_order`) count. Places outside the image may be True."""
        firsts = TileGrid(self.sizes[list(view_ids)]).starts
        spans = [slice(int(self.offsets[view]), int(self.offsets[view + 1])) for view in view_ids]
        tiles = torch.cat([self.tiles[span].long() + first for span, first in zip(spans, firsts, strict=False)])
        words = self.bits[torch.cat([self.rows[span] for span in spans]).long()]  # [T, WORDS]
        shifts = torch.arange(WORD_BITS, dtype=torch.int32, device=words.device)
        return tiles, ((words[:, :, None] >> shifts) & 1).bool().reshape(-1, TILE_PIXELS)

    def image(self, view_id: int) -> Tensor:
        """[H, W] bool on the masks' device: the mask of one view."""
        width, height = self.sizes[view_id].tolist()
        image = torch.zeros(height * width, dtype=torch.bool, device=self.tiles.device)
        image[self.pixels([view_id]).pixel_ids.long()] = True
        return image.view(height, width)

    def pixels(self, view_ids: Sequence[int]) -> PixelSamples:
        """Every pixel of these views that is not masked, in the order of samples. The host waits for the device."""
        view_ids = tuple(view_ids)
        sizes = self.sizes[list(view_ids)]
        tiles, live = self.live_tiles(view_ids)
        table = pixel_table(sizes, self.tiles.device)[tiles]
        live &= table >= 0
        offsets = torch.nn.functional.pad(live.sum(dim=1).cumsum(dim=0), (1, 0))
        return PixelSamples(view_ids, sizes, table[live], tiles.int(), offsets.int(), has_empty_slots=False)

    def strip(self, samples: PixelSamples) -> PixelSamples:
        """Samples of a sampler that knows no masks, without masked pixels, empty slots and tiles with nothing left.
        Weights have a mean of 1 again. The host waits for the device."""
        images = torch.cat([self.image(view).reshape(-1) for view in samples.view_ids])  # of the batch, end to end
        pixels = self.sizes[list(samples.view_ids)].prod(axis=1)
        starts = torch.as_tensor(np.cumsum(pixels) - pixels, device=images.device)[samples.view_of_slot()]
        keep = samples.filled & images[starts + samples.pixel_ids.long().clamp(min=0)]
        counts = torch.zeros_like(samples.tile_ids).index_add_(0, samples.tile_of_slot(), keep.int())
        left = counts > 0
        weights = None if samples.weights is None else samples.weights[keep] / samples.weights[keep].mean()
        offsets = torch.nn.functional.pad(counts[left].cumsum(dim=0), (1, 0)).int()
        kept = (samples.pixel_ids[keep], samples.tile_ids[left], offsets, weights)
        return PixelSamples(samples.view_ids, samples.sizes, *kept, has_empty_slots=False, origin=samples.origin)
