"""Photos as training wants them: uint8, the pixels of all views laid end to end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.scene.depths import DepthPair
from turbogs_plugin.types import BLACK, Color, PixelSamples

PHOTO_BYTES = 3
"""Bytes of a pixel of an opaque photo; a transparent one has one more."""


@dataclass
class Photos:
    """The photos of V views.

    Args:
        colors: [X, 3] uint8, row-major pixels of one view after the other. Or [X, 4] where photos are transparent:
            colours times alpha, and alpha; the background shows through them.
        sizes: [V, 2] int64, (width, height).
    """

    colors: Tensor
    sizes: np.ndarray

    def __len__(self) -> int:
        return len(self.sizes)

    @cached_property
    def offsets(self) -> np.ndarray:
        """[V + 1] int64: the first flat pixel of each view, and the count of all at the end."""
        return pixel_offsets(self.sizes)

    @property
    def stored(self) -> Tensor:
        """[X, 3 or 4] uint8: the pixels of all views end to end, wherever they are."""
        return self.colors

    @property
    def transparent(self) -> bool:
        """True where pixels have an alpha."""
        return self.stored.shape[1] == 4

    def fetch(self, view_ids: Sequence[int]) -> None:
        """Make the photos of these views available in `colors`, from `offsets` on. To be called before these arrays are
        read. Here all views are always there; see `scene/offload.py`."""

    def at(self, samples: PixelSamples, background: Color = BLACK) -> PhotoSamples:
        """The photos at the samples, on a background. To be used before the photos of other views are fetched."""
        self.fetch(samples.view_ids)
        return PhotoSamples(self, samples, background)

    def image(self, view_id: int, background: Color = BLACK) -> Tensor:
        """[H, W, 3] float32, 0 .. 1: one whole photo, on a background."""
        self.fetch([view_id])
        width, height = self.sizes[view_id].tolist()
        pixels = self.colors[int(self.offsets[view_id]) :][: width * height]
        return _on_background(pixels, background).view(height, width, 3)

    def to(self, device: torch.device | str) -> Photos:
        return Photos(self.colors.to(device), self.sizes)


@dataclass(frozen=True)
class PhotoSamples:
    """Ground truth of an iteration, not gathered yet: the kernel of the loss reads the photos itself."""

    photos: Photos
    samples: PixelSamples
    background: Color = BLACK
    depths: DepthPair | None = None  # for a loss with a depth term

    @property
    def starts(self) -> np.ndarray:
        """[K] int64: the first flat pixel of each view of the batch."""
        return self.photos.offsets[list(self.samples.view_ids)]

    def colors(self) -> Tensor:
        """[P, 3] float32, 0 .. 1: the colours at the samples, 0 in empty slots."""
        pixels = self.samples.flat_pixels(self.photos.offsets)
        return _on_background(self.photos.colors[pixels], self.background).mul_(self.samples.filled[:, None])


def _on_background(pixels: Tensor, background: Color) -> Tensor:
    """[P, 3] float32, 0 .. 1, of [P, 3 or 4] uint8: ``colour + (1 - alpha) * background``."""
    colors = pixels.float().div_(255.0)
    if colors.shape[1] == 3 or not any(background):
        return colors[:, :3]
    return torch.stack([colors[:, c] + (1.0 - colors[:, 3]) * background[c] for c in range(3)], dim=1)


def pixel_offsets(sizes: np.ndarray) -> np.ndarray:
    """[V + 1] int64: running count of the pixels of views of these `sizes` [V, 2]."""
    return np.concatenate([[0], np.cumsum(sizes.prod(axis=1))]).astype(np.int64)
