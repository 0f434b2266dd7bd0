"""Photos as training wants them: uint8, the pixels of all views laid end to end."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.host_arrays import free_host_bytes, host_array
from turbogs_plugin.scene.undistort import Lens
from turbogs_plugin.types import PixelSamples

PHOTO_BYTES = 3
"""Bytes of a pixel."""
SMALLEST_SIDE = 4
"""The shorter side of a reduced photo has at least so many pixels: those of a cell."""
DECODING_BYTES = 24
"""Bytes of a pixel while its photo is decoded, undistorted and reduced: several copies, one of them in float32."""
MEMORY_SHARE = 0.25
"""Photos that are being decoded may take this share of the free memory, with one thread more if need be."""
SMALL_WORK = 2**30
"""Bytes that are not worth a question."""


@dataclass
class Photos:
    """The photos of V views.

    Args:
        colors: [X, 3] uint8, row-major pixels of one view after the other.
        sizes: [V, 2] int64 numpy array (width, height).
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
        """[X, 3] uint8: the pixels of all views end to end, wherever they are."""
        return self.colors

    def fetch(self, view_ids: Sequence[int]) -> None:
        """Make the photos of these views available in `colors`, from `offsets` on.

        Call it before reading these arrays. Here all views are always there; see `scene/offload.py`.
        """

    def at(self, samples: PixelSamples) -> PhotoSamples:
        """The photos at the samples. To be used before the photos of other views are fetched."""
        self.fetch(samples.view_ids)
        return PhotoSamples(self, samples)

    def image(self, view_id: int) -> Tensor:
        """[H, W, 3] float32, 0 .. 1: one whole photo."""
        self.fetch([view_id])
        width, height = self.sizes[view_id].tolist()
        start = int(self.offsets[view_id])
        return self.colors[start : start + width * height].view(height, width, 3).float().div_(255.0)

    def to(self, device: torch.device | str) -> Photos:
        return Photos(self.colors.to(device), self.sizes)


@dataclass(frozen=True)
class PhotoSamples:
    """Ground truth of an iteration, not gathered yet: the kernel of the loss reads the photos itself."""

    photos: Photos
    samples: PixelSamples

    @property
    def starts(self) -> np.ndarray:
        """[K] int64: the first flat pixel of each view of the batch."""
        return self.photos.offsets[list(self.samples.view_ids)]

    def colors(self) -> Tensor:
        """[P, 3] float32, 0 .. 1: the colours at the samples, 0 in empty slots."""
        pixels = self.samples.flat_pixels(self.photos.offsets)
        return self.photos.colors[pixels].float().div_(255.0).mul_(self.samples.filled[:, None])


def pixel_offsets(sizes: np.ndarray) -> np.ndarray:
    """[V + 1] int64: running count of the pixels of views of these `sizes` [V, 2]."""
    return np.concatenate([[0], np.cumsum(sizes.prod(axis=1))]).astype(np.int64)


def reduced_sizes(sizes: np.ndarray, factor: int) -> np.ndarray:
    """[V, 2] int64: sizes divided by `factor`, to the nearest pixel.

    Raises:
        InputError: the factor leaves a side of less than `SMALLEST_SIDE`.
    """
    reduced = np.floor(sizes / factor + 0.5).astype(np.int64)
    if factor > 1 and reduced.min() < SMALLEST_SIDE:
        width, height = sizes[sizes.min(axis=1).argmin()].tolist()
        largest = max(1, int(min(width, height) / (SMALLEST_SIDE - 0.5)))
        raise InputError(
            f"--factor {factor} leaves too little of photos of {width}x{height}: the largest that keeps "
            f"{SMALLEST_SIDE} pixels a side is {largest}"
        )
    return reduced


def photo_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header alone; `InputError` where it cannot be read."""
    with _opened(path) as image:
        return image.size


def photo_sizes(paths: Sequence[Path]) -> np.ndarray:
    """[V, 2] int64 (width, height), from the headers; `InputError` names the first file that cannot be read."""
    with _threads() as pool:
        return np.array(list(pool.map(photo_size, paths)), dtype=np.int64).reshape(-1, 2)


def photo_array(sizes: np.ndarray) -> Tensor:
    """[X, 3] uint8 for photos of these `sizes` [V, 2], with any content, wherever there is room (`host_array`).

    Raises:
        InputError: more photos than fit in memory or on the disk.
    """
    return host_array((int(pixel_offsets(sizes)[-1]), 3), torch.uint8, f"{len(sizes)} photos")


def load_photos(
    paths: Sequence[Path],
    sizes: np.ndarray,
    targets: np.ndarray,
    lenses: Sequence[Lens | None] = (),
    colors: Tensor | None = None,
    loaded: Callable[[], object] = lambda: None,
) -> Photos:
    """Decode photos in parallel, undistorted, then reduced to their target sizes by area averaging.

    Transparent photos are composited over black, the background that renders have. Photos are taken as stored:
    an orientation in EXIF is ignored, as COLMAP does.

    Args:
        paths: V files.
        sizes: [V, 2] int64 (width, height) that the files must have.
        targets: [V, 2] int64 (width, height) to give them.
        lenses: one a photo, None for those of pinhole cameras; or empty, where all are.
        colors: where to put them, as `photo_array` gives it; None: it is asked for it.
        loaded: called after each photo, in their order.

    Raises:
        InputError: a photo that cannot be decoded, or is of another size (the first one in order is named); more
            photos than there is room for.
    """
    offsets = pixel_offsets(targets)
    colors = photo_array(targets) if colors is None else colors
    pixels = colors.numpy()

    def load(view: int) -> None:
        target = tuple(targets[view].tolist())
        photo = _decode(paths[view], tuple(sizes[view].tolist()))
        lens = lenses[view] if lenses else None
        if lens is not None:
            photo = Image.fromarray(lens.undistort(np.asarray(photo), lens.size_of(photo.size)))
        if photo.size != target:
            photo = photo.resize(target, Image.Resampling.BOX)
        pixels[offsets[view] : offsets[view + 1]] = np.asarray(photo).reshape(-1, 3)

    largest = int(sizes.prod(axis=1).max(initial=1))
    with _threads(DECODING_BYTES * largest) as pool:
        for _ in pool.map(load, range(len(paths))):  # raises the first error in order, and cancels what has not begun
            loaded()
    return Photos(colors, targets)


def _threads(bytes_each: int = 0) -> ThreadPoolExecutor:
    """As many as there are processors, but no more than `MEMORY_SHARE` of the free memory allows."""
    wanted = min(8, os.cpu_count() or 1)
    affordable = int(MEMORY_SHARE * free_host_bytes()) // bytes_each if wanted * bytes_each > SMALL_WORK else wanted
    return ThreadPoolExecutor(max(1, min(wanted, affordable)))


def _decode(path: Path, size: tuple[int, int]) -> Image.Image:
    """An RGB image of exactly this size, or `InputError`. The size is checked before any pixel is decoded."""
    with _opened(path) as image:
        if image.size != size:
            raise InputError(
                f"photo {path} is {image.size[0]}x{image.size[1]} but its camera is {size[0]}x{size[1]}: "
                "use the photos that the cameras were reconstructed from"
            )
        if image.mode.startswith(("I", "F")):
            raise InputError(f"photo {path} has more than 8 bits a channel: convert it to 8-bit RGB")
        if "A" in image.getbands() or "transparency" in image.info:
            image = image.convert("RGBA")
            return Image.alpha_composite(Image.new("RGBA", size, (0, 0, 0, 255)), image).convert("RGB")
        return image.convert("RGB")


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The photo with its header read; `InputError` for whatever goes wrong with it while entered."""
    try:
        with Image.open(path) as image:
            yield image
    except InputError:
        raise
    except Exception as error:  # a broken file can raise anything in its decoder
        reason = " ".join((str(error) or type(error).__name__).split())
        raise InputError(f"cannot read the photo {path}: {reason}") from error
