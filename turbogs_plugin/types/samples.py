"""The pixels of one iteration, tile by tile, and the result of a loss on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.device import on_device
from turbogs_plugin.errors import InputError

TILE_SIZE = 16
"""Side of a square tile in pixels (S in the paper). The kernels are built for this value."""

PATCH_WIDTH, PATCH_HEIGHT = 8, 4
"""Samples of a tile are ordered by patches of this size, so that in a dense tile a warp gets 32 neighbours."""


def sample_order(x: Tensor, y: Tensor) -> Tensor:
    """Rank of a pixel within its tile, 0 .. TILE_SIZE^2 - 1: row-major over patches of 8x4, then within the patch. `x`,
    `y`: integer tensors of one shape, coordinates within the tile."""
    patch = (y // PATCH_HEIGHT) * (TILE_SIZE // PATCH_WIDTH) + x // PATCH_WIDTH
    return patch * (PATCH_WIDTH * PATCH_HEIGHT) + (y % PATCH_HEIGHT) * PATCH_WIDTH + x % PATCH_WIDTH


@lru_cache(maxsize=4096)
def _starts(sizes: bytes, origin: tuple[int, int]) -> tuple[int, ...]:
    """`TileGrid.starts` of these int64 sizes. The result is kept, as iterations ask for few sizes again and again."""
    grid = TileGrid(np.frombuffer(sizes, dtype=np.int64).reshape(-1, 2), origin)
    return 0, *grid.shapes.prod(axis=1).cumsum().tolist()


@dataclass
class TileGrid:
    """The tiles of a batch of K images, numbered without gaps: view after view, row after row.

    Args:
        sizes: [K, 2] int64 numpy array (width, height).
        origin: (x, y), 0 .. TILE_SIZE - 1, pixels by which the first tile of each image begins left of it and above.
    """

    sizes: np.ndarray
    origin: tuple[int, int] = (0, 0)

    @property
    def shapes(self) -> np.ndarray:
        """[K, 2] int64: tiles in x and in y of each image."""
        return -(-(self.sizes + self.origin) // TILE_SIZE)

    @property
    def starts(self) -> tuple[int, ...]:
        """K + 1 numbers: the first tile of each image, and at the end the count of all tiles."""
        return _starts(np.asarray(self.sizes, dtype=np.int64).tobytes(), tuple(self.origin))

    def __len__(self) -> int:
        return self.starts[-1]


@dataclass
class PixelSamples:
    """The pixels of one iteration, grouped by tile.

    A slot whose pixel id is -1 is empty: it renders nothing, adds nothing to a loss and changes no map. A whole tile
    that the image's edge or a mask cuts has empty slots, and so has a masked tile from which pixels are drawn: the host
    then knows the number of slots.

    Args:
        view_ids: K numbers of training views, on the host.
        sizes: [K, 2] int64 numpy array (width, height) of those views.
        pixel_ids: [P] int32, ``y * width + x`` in its own view, or -1 for an empty slot. Within a tile, ascending
            in `sample_order`, empty slots last.
        tile_ids: [T] int32, ascending, in the numbering of ``TileGrid(sizes, origin)``.
        tile_offsets: [T + 1] int32, the first slot of each tile; the last entry is P.
        weights: [P] float32 importance weights with mean 1 over the filled slots, or None where all are 1.
        has_empty_slots: False promises that every slot is filled, so that none has to be counted.
        host_ends: gives ([K], [T]) int64 numpy arrays, the end of each view's tiles (in `tile_ids`) and of each tile's
            slots, where the host knows them without asking the device; None: it has to ask.
        origin: of the grid of tiles, see `TileGrid`.
    """

    view_ids: tuple[int, ...]
    sizes: np.ndarray
    pixel_ids: Tensor
    tile_ids: Tensor
    tile_offsets: Tensor
    weights: Tensor | None = None
    has_empty_slots: bool = True
    host_ends: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None
    origin: tuple[int, int] = (0, 0)

    @classmethod
    def from_mask(cls, mask: Tensor, view_ids: Sequence[int] | None = None) -> PixelSamples:
        """The pixels of a mask. On a GPU the host waits, to count them.

        Args:
            mask: [H, W] bool of one view, or [K, H, W] of a batch. The samples live on its device.
            view_ids: K training views, for error maps; 0 .. K - 1 where None.

        Raises:
            InputError: no such mask, one that is False everywhere, or not one view number for each image.
        """
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.dim() not in (2, 3) or not mask.any():
            raise InputError("mask is not a tensor of bool [H, W] or [K, H, W] with a pixel that is True")
        mask = mask[None] if mask.dim() == 2 else mask
        count, height, width = mask.shape
        view_ids = tuple(range(count) if view_ids is None else map(int, view_ids))
        if len(view_ids) != count or len(set(view_ids)) < count:
            raise InputError(f"view_ids = {view_ids} is not valid: expected {count} different numbers of views")
        sizes = np.array([(width, height)] * count, dtype=np.int64)
        grid = TileGrid(sizes)
        views, y, x = torch.nonzero(mask, as_tuple=True)  # [P] each
        tiles = torch.as_tensor(grid.starts[:-1], device=mask.device)[views]
        tiles = tiles + y // TILE_SIZE * int(grid.shapes[0, 0]) + x // TILE_SIZE
        keys, order = (tiles * TILE_SIZE**2 + sample_order(x % TILE_SIZE, y % TILE_SIZE)).sort()
        tile_ids, counts = torch.unique_consecutive(keys // TILE_SIZE**2, return_counts=True)  # [T] each
        pixel_ids = (y * width + x)[order].int()
        tile_offsets = torch.nn.functional.pad(counts.cumsum(dim=0), (1, 0)).int()
        return cls(view_ids, sizes, pixel_ids, tile_ids.int(), tile_offsets, has_empty_slots=False)

    def __len__(self) -> int:
        return self.pixel_ids.shape[0]

    @property
    def grid(self) -> TileGrid:
        return TileGrid(self.sizes, self.origin)

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """([K], [T]) int64: the end of each view's tiles (in `tile_ids`) and of each tile's slots. Without `host_ends`
        the host waits for the device."""
        if self.host_ends is not None:
            return self.host_ends()
        views = np.searchsorted(self.tile_ids.cpu().numpy(), self.grid.starts[1:])
        return views, self.tile_offsets[1:].cpu().numpy().astype(np.int64)

    def of_tiles(self, tiles: slice, views: slice, slots: slice) -> PixelSamples:
        """A run of tiles (positions in `tile_ids`) as a batch of its own, of the `views` that they lie in (positions in
        the batch), with their `slots`. Tensors are views of these ones."""
        tile_offsets = self.tile_offsets[tiles.start : tiles.stop + 1]
        starts = self.grid.starts
        first = starts[views.start]
        if self.tile_ids.shape[0] == starts[-1]:  # all tiles, so their numbers are there already
            tile_ids = self.tile_ids[tiles.start - first : tiles.stop - first]
        else:
            tile_ids = self.tile_ids[tiles] - first
        tile_offsets = tile_offsets - slots.start if slots.start else tile_offsets
        weights = None if self.weights is None else self.weights[slots]
        parts = self.pixel_ids[slots], tile_ids, tile_offsets, weights, self.has_empty_slots
        return PixelSamples(self.view_ids[views], self.sizes[views], *parts, origin=self.origin)

    @property
    def filled(self) -> Tensor:
        """[P] bool: the slot holds a pixel."""
        return self.pixel_ids >= 0

    def tile_of_slot(self) -> Tensor:
        """[P] int64: position in `tile_ids` of the tile of each slot."""
        counts = (self.tile_offsets[1:] - self.tile_offsets[:-1]).long()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts, output_size=len(self))

    def view_of_tile(self) -> Tensor:
        """[T] int64: position in the batch (0 .. K-1) of the view of each tile of `tile_ids`."""
        ends = on_device(self.grid.starts[1:], self.tile_ids.device)
        return torch.searchsorted(ends, self.tile_ids.long(), right=True)

    def view_of_slot(self) -> Tensor:
        """[P] int64: position in the batch (0 .. K-1) of the view of each slot."""
        return self.view_of_tile()[self.tile_of_slot()]

    def flat_pixels(self, offsets: np.ndarray) -> Tensor:
        """[P] int64: flat pixel of each slot; an empty slot gets the first pixel of its view. `offsets`: [V + 1] int64,
        first flat pixel of each training view."""
        starts = torch.as_tensor(offsets[list(self.view_ids)], device=self.pixel_ids.device)
        return starts[self.view_of_slot()] + self.pixel_ids.long().clamp(min=0)

    def coordinates(self) -> Tensor:
        """[P, 2] int64 (x, y) of each slot in its view; (0, 0) for an empty slot."""
        widths = torch.as_tensor(self.sizes[:, 0], device=self.pixel_ids.device)[self.view_of_slot()]
        pixels = self.pixel_ids.long().clamp(min=0)
        return torch.stack([pixels % widths, pixels // widths], dim=-1)


@dataclass
class LossOutput:
    """The result of a loss on the samples.

    Args:
        loss: scalar.
        color_gradients: [P, 3], d loss / d rendered colour.
        pixel_errors: [P] float32, L1 norm over RGB of the residual (0 .. 3); zero in empty slots.
        depth_gradients: [P], d loss / d rendered depth; None: the loss has no such term.
    """

    loss: Tensor
    color_gradients: Tensor
    pixel_errors: Tensor
    depth_gradients: Tensor | None = None
