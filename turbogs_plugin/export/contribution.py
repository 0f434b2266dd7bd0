"""Which Gaussians a model can best do without: those that add least to the training views."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.rendering import RasterSettings, dense_samples, rasterize
from turbogs_plugin.types import Cameras, Gaussians


@torch.no_grad()
def contributions(gaussians: Gaussians, cameras: Cameras, settings: RasterSettings) -> Tensor:
    """[N] float64, on the Gaussians' device: the sum of each one's blending weights T * alpha, over all pixels of some
    views.

    Args:
        cameras: of the views; on any device.
    """
    cameras = cameras.to(gaussians.device)
    sums = torch.zeros(len(gaussians), dtype=torch.float64, device=gaussians.device)
    for view in range(len(cameras)):
        samples = dense_samples(cameras, [view])
        rendered = rasterize(gaussians, cameras.select([view]), samples, sh_degree=0, settings=settings)
        screen = rendered.backward(torch.zeros_like(rendered.colors))
        sums += screen.full_records()[0, :, ScreenRecord.WEIGHT_SUM]
    return sums


def pruned(gaussians: Gaussians, weights: Tensor, count: int) -> Gaussians:
    """The `count` Gaussians with the largest of the `weights` [N], in their order."""
    kept = torch.argsort(weights, descending=True, stable=True)[:count].sort().values
    return gaussians.map(lambda value: value[kept])
