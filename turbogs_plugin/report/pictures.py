"""Pictures of views: strips of ground truth, render and error; depths."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from turbogs_plugin.device import processor_cores
from turbogs_plugin.files import naming
from turbogs_plugin.report.inferno import INFERNO

ERROR_FULL_SCALE = 0.25
"""Mean absolute error over RGB at which an error map has its brightest colour."""

FAINTEST = 0.1
"""Place of the farthest depth on the scale of colours, 0 .. 1: it can be told from black."""

MASKED = 128
"""Grey of masked pixels."""

GAP = 6
"""White pixels between the pictures of a strip."""

JPEG_QUALITY = 92
"""Of strips. With full resolution of colours they look as PNGs do, at a tenth of their time and size."""

THREADS = 8
"""Files that are encoded at a time; the encoders run without Python's lock."""


@contextmanager
def picture_writer() -> Iterator[Callable[[Path, np.ndarray], None]]:
    """Gives a function that writes a picture, [H, W, 3] uint8, to a file in a thread; the suffix says in which format.

    Leaving waits for all files, and raises the first error.
    """
    jobs = []
    with ThreadPoolExecutor(min(THREADS, processor_cores())) as pool:
        yield lambda path, pixels: jobs.append(pool.submit(_save, path, pixels))
    for job in jobs:
        job.result()


def _save(path: Path, pixels: np.ndarray) -> None:
    options = {"quality": JPEG_QUALITY, "subsampling": 0} if path.suffix == ".jpg" else {}
    with naming(path):
        Image.fromarray(pixels).save(path, **options)


def strip(photo: Tensor, image: Tensor, mask: Tensor | None = None) -> np.ndarray:
    """[H, 3 W + 2 `GAP`, 3] uint8: ground truth, render and error map side by side.

    Args:
        photo, image: [H, W, 3] float, 0 .. 1, on one device, where the strip is made.
        mask: [H, W] bool; where it is False, photo and error are `MASKED`. None: nowhere.
    """
    white = torch.full((photo.shape[0], GAP, 3), 255, dtype=torch.uint8, device=photo.device)
    truth, errors = rounded(photo), error_picture(photo, image)
    if mask is not None:
        truth, errors = (torch.where(mask[:, :, None], part, MASKED) for part in (truth, errors))
    return torch.cat((truth, white, rounded(image), white, errors), dim=1).cpu().numpy()


def error_picture(photo: Tensor, image: Tensor) -> Tensor:
    """[H, W, 3] uint8: mean absolute error over RGB, black (none) to bright yellow (`ERROR_FULL_SCALE` and more)."""
    return colored((photo - image).abs().mean(dim=-1) / ERROR_FULL_SCALE)


def depth_picture(depths: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 of depths [H, W]: near is bright, far is dark, and what has no depth (0) is black.

    The scale of colours is even in 1 / depth, so that near depths have most of it, and goes from the 1st to the 99th
    percentile of 1 / depth in this image.
    """
    seen = depths > 0
    if not seen.any():
        return np.zeros((*depths.shape, 3), dtype=np.uint8)
    nearness = 1.0 / np.where(seen, depths, 1.0)
    far, near = np.percentile(nearness[seen], [1, 99])
    share = ((nearness - far) / max(near - far, np.finfo(np.float32).tiny)).clip(0.0, 1.0)
    return colored(torch.from_numpy(FAINTEST + (1.0 - FAINTEST) * share)).numpy() * seen[..., None]


def colored(share: Tensor) -> Tensor:
    """[H, W, 3] uint8: black (0) to bright yellow (1 and more)."""
    palette = torch.from_numpy(INFERNO.copy()).to(share.device)  # [256, 3]
    return palette[(share * len(palette)).clamp(0, len(palette) - 1).long()]


def to_uint8(image: Tensor) -> np.ndarray:
    """[H, W, 3] uint8 of an image of floats 0 .. 1: `rounded`, on the CPU."""
    return rounded(image).cpu().numpy()


def rounded(image: Tensor) -> Tensor:
    """[H, W, 3] uint8 of an image of floats 0 .. 1, on its device."""
    return (image.clamp(0.0, 1.0) * 255.0).round().byte()
