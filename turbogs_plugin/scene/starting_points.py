"""Random points to start from, for captures that bring none, in colours from the photos."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.photos import Photos, pixel_offsets
from turbogs_plugin.scene.poses import camera_centers, evenly
from turbogs_plugin.types import Cameras

NUM_RANDOM_POINTS = 50_000
COLOR_VIEWS = 32
"""Photos that give random points their colours, at most."""


def random_points(viewmats: np.ndarray) -> np.ndarray:
    """[M, 3] float64, the same for the same cameras.

    The cube's centre is the point nearest to all viewing axes, its side the median distance of the cameras from it.

    Args:
        viewmats: [V, 4, 4] float64 world to camera.
    """
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    # A slight pull towards the cameras' mean settles the case of parallel axes.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [V, 3, 3]
    mean = centers.mean(axis=0)
    pull = 1e-3 * len(centers) * np.eye(3)
    offsets = np.einsum("vij,vj->i", across, centers - mean)
    focus = mean + np.linalg.solve(across.sum(axis=0) + pull, offsets)
    side = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    random = np.random.default_rng(0)
    return focus + random.uniform(-0.5, 0.5, (NUM_RANDOM_POINTS, 3)) * (side or 1.0)


def colors_in_photos(points: Tensor, cameras: Cameras, photos: Photos, masks: PixelMasks | None = None) -> Tensor:
    """[M, 3] uint8: for each point the mean colour of the pixels at which photos see it, hidden or not.

    Masked pixels do not count, and transparent ones by their alpha. Points that none sees get the mean of the others;
    grey where there is none.

    Args:
        points: [M, 3] float32.
        cameras, photos: of V views in the same coordinates, of which at most `COLOR_VIEWS`, evenly spread, are used.
        masks: which pixels count, on the CPU; None for all.
    """
    cameras, points = cameras.to("cpu", torch.float32), points.cpu()
    sums, counts = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for view in evenly(len(photos), COLOR_VIEWS):
        viewmat, (width, height) = cameras.viewmats[view], photos.sizes[view].tolist()
        in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        depths = in_camera[:, 2]
        x, y = ((in_camera @ cameras.Ks[view].T)[:, :2] / depths.clamp(min=1e-9)[:, None]).unbind(dim=1)
        inside = ((depths > 1e-9) & (x >= 0) & (y >= 0) & (x < width) & (y < height)).nonzero()[:, 0]
        pixels = y[inside].long().clamp(max=height - 1) * width + x[inside].long().clamp(max=width - 1)
        start = int(pixel_offsets(photos.sizes)[view])
        seen = photos.stored[(start + pixels).to(photos.stored.device)].cpu().float()
        if not photos.transparent:
            seen = torch.nn.functional.pad(seen, (0, 1), value=255.0)
        if masks is not None:
            seen *= masks.image(view).reshape(-1)[pixels, None]
        sums.index_add_(0, inside, seen[:, :3])  # which are multiplied by alpha already
        counts.index_add_(0, inside, seen[:, 3:] / 255.0)
    others = sums.sum(dim=0) / counts.sum() if counts.any() else torch.full((3,), 128.0)
    return torch.where(counts > 0, sums / counts.clamp(min=1e-9), others).round().to(torch.uint8)


def about_cameras(count: int) -> str:
    """What `random_points` gives, for a note: so many of them."""
    return f"{count:,} random ones about what the cameras look at"
