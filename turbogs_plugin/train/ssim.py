"""SSIM of whole images, as Wang et al. 2004 define it."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

SSIM_SIDE = 11
"""Side of the Gaussian window; a smaller image has no SSIM."""

SIGMA = 1.5
"""Standard deviation of the window, in pixels."""

C1, C2 = 0.01**2, 0.03**2
"""The paper's constants for values 0 .. 1."""


def ssim(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity, the mean over all pixels and channels; borders are mirrored, as torchmetrics does.

    Args:
        image, photo: [H, W, 3] float, 0 .. 1, with sides of at least `SSIM_SIDE`.
        mask: [H, W] bool, the pixels to take the mean over; None: all.

    Returns:
        A scalar on the images' device.
    """
    x, y = (picture.permute(2, 0, 1) for picture in (image, photo))  # [3, H, W]
    mean_x, mean_y, xx, yy, xy = _blurred(torch.stack((x, y, x * x, y * y, x * y)))
    variances = (xx - mean_x.square()).clamp(min=0.0) + (yy - mean_y.square()).clamp(min=0.0)
    covariance = xy - mean_x * mean_y
    similar_means = (2.0 * mean_x * mean_y + C1) / (mean_x.square() + mean_y.square() + C1)
    similarity = similar_means * (2.0 * covariance + C2) / (variances + C2)  # [3, H, W]
    return similarity.mean() if mask is None else similarity[:, mask].mean()


def _blurred(images: Tensor) -> Tensor:
    """[B, 3, H, W] images under the window, which is a product: down the columns first, then along the rows.

    Shifted sums, not a convolution: these need no library that is loaded for them.
    """
    margin = SSIM_SIDE // 2
    weights = [math.exp(-0.5 * (place / SIGMA) ** 2) for place in range(-margin, margin + 1)]
    padded = F.pad(images, (margin,) * 4, mode="reflect")
    for axis in (2, 3):
        size = images.shape[axis]
        blurred = padded.narrow(axis, 0, size) * (weights[0] / sum(weights))
        for place in range(1, SSIM_SIDE):
            blurred.add_(padded.narrow(axis, place, size), alpha=weights[place] / sum(weights))
        padded = blurred
    return padded
