"""Pictures of views as arrays of bytes: strips of photo, render and error; errors and depths in colours."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from turbogs_plugin.files import naming, new_file

ERROR_FULL_SCALE = 0.25
"""Mean absolute error over RGB at which an error map has its brightest colour."""
FAINTEST = 0.1
"""Place of the farthest depth on the scale of colours, 0 .. 1: it can be told from black."""
MASKED = 128
"""Grey of masked pixels."""
GAP = 6
"""White pixels between the pictures of a strip."""
TITLE = 24
"""Pixels of the bar of titles above a strip."""
JPEG_QUALITY = 92
"""Quality of a strip's JPEG. With full resolution of colours it looks as a PNG does, at a tenth of the size."""


def save_image(path: Path, pixels: np.ndarray) -> None:
    """Write a picture, [H, W, 3] uint8, as its suffix says, .jpg or .png. Raises `OSError`, which names the file."""
    kind = "JPEG" if path.suffix == ".jpg" else "PNG"  # which has no use for the options
    with naming(path), new_file(path) as file:
        Image.fromarray(pixels).save(file, kind, quality=JPEG_QUALITY, subsampling=0)


def strip(photo: Tensor, image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Photo, render and error map side by side, [H, 3 W + 2 `GAP`, 3] uint8 on their device.

    Args:
        photo, image: [H, W, 3] float, 0 .. 1, on one device.
        mask: [H, W] bool; where it is False, photo and error are `MASKED`. None: nowhere.
    """
    white = torch.full((photo.shape[0], GAP, 3), 255, dtype=torch.uint8, device=photo.device)
    truth, errors = rounded(photo), error_picture(photo, image)
    if mask is not None:
        truth, errors = (torch.where(mask[:, :, None], part, MASKED) for part in (truth, errors))
    return torch.cat((truth, white, rounded(image), white, errors), dim=1)


def titled(pixels: np.ndarray) -> np.ndarray:
    """A strip, [H, 3 W + 2 `GAP`, 3] uint8, below a bar of `TITLE` rows: the names of its pictures, and beside that of
    the error the scale of its colours."""
    bar = Image.new("RGB", (pixels.shape[1], TITLE), "white")
    draw, font, step = ImageDraw.Draw(bar), ImageFont.load_default(size=15), (pixels.shape[1] + GAP) // 3
    for left, name in ((0, "photo"), (step, "render"), (2 * step, "error 0"), (2 * step + 108, f"{ERROR_FULL_SCALE}")):
        draw.text((left + 4, 2), name, fill="black", font=font)
    scale = colored(torch.linspace(0.0, 1.0, 48).expand(TITLE - 10, 48)).numpy()
    bar.paste(Image.fromarray(scale), (2 * step + 60, 6))
    return np.concatenate((np.asarray(bar), pixels))


def error_picture(photo: Tensor, image: Tensor) -> Tensor:
    """Mean absolute error over RGB, [H, W, 3] uint8: black (none) to bright yellow (`ERROR_FULL_SCALE` and more)."""
    return colored((photo - image).abs().mean(dim=-1) / ERROR_FULL_SCALE)


def depth_picture(depths: np.ndarray) -> np.ndarray:
    """Depths [H, W] as a picture, [H, W, 3] uint8: near is bright, far is dark, no depth (0) is black. The scale of
    colours is even in 1 / depth, so that near depths have most of it, from its 1st to its 99th percentile."""
    if not (seen := depths > 0).any():
        return np.zeros((*depths.shape, 3), dtype=np.uint8)
    nearness = 1.0 / np.where(seen, depths, 1.0)
    far, near = np.percentile(nearness[seen], [1, 99])
    share = ((nearness - far) / max(near - far, np.finfo(np.float32).tiny)).clip(0.0, 1.0)
    return colored(torch.from_numpy(FAINTEST + (1.0 - FAINTEST) * share)).numpy() * seen[..., None]


@cache
def _palette() -> Tensor:
    """The colours of matplotlib's inferno, [256, 3] uint8: black to bright yellow."""
    import matplotlib

    colors = matplotlib.colormaps["inferno"](np.arange(256))[:, :3]
    return torch.from_numpy((255.0 * colors).round().astype(np.uint8))


def colored(share: Tensor) -> Tensor:
    """Shares [H, W] as colours, [H, W, 3] uint8: black (0) to bright yellow (1 and more)."""
    palette = _palette().to(share.device)
    return palette[(share * len(palette)).clamp(0, len(palette) - 1).long()]


def to_uint8(image: Tensor) -> np.ndarray:
    """An image of floats 0 .. 1 as bytes on the CPU, [H, W, 3] uint8."""
    return rounded(image).cpu().numpy()


def rounded(image: Tensor) -> Tensor:
    """An image of floats 0 .. 1 as bytes on its device, [H, W, 3] uint8."""
    return (image.clamp(0.0, 1.0) * 255.0).round().byte()
