"""gsplat's dense rasterizer on the same views, to compare with."""

from __future__ import annotations

from functools import partial
from typing import Any

import gsplat
import torch

from turbogs_plugin.bench.clocks import measure
from turbogs_plugin.types import Cameras, Gaussians


def bench_gsplat(model: Gaussians, cameras: Cameras, repeats: int) -> dict[str, Any]:
    """Times of gsplat's forward and backward pass over every pixel, or why there are none."""
    if not model.means.is_cuda:
        return {"version": gsplat.__version__, "reason": "gsplat's rasterization needs a GPU"}
    leaves = model.map(lambda value: value.clone().requires_grad_())
    width, height = (int(side) for side in cameras.sizes[0])
    weights = torch.randn(len(cameras), height, width, 3, device=model.device)

    def whole(packed: bool) -> None:
        shapes = leaves.means, leaves.quats, leaves.scales.exp(), leaves.opacities.sigmoid()
        colors, views = torch.cat([leaves.sh0, leaves.shN], dim=1), (cameras.viewmats, cameras.Ks, width, height)
        options = {"sh_degree": leaves.sh_degree, "packed": packed, "absgrad": True}
        images, _, _ = gsplat.rasterization(*shapes, colors, *views, **options)
        torch.autograd.grad((images * weights).sum(), [value for _, value in leaves.items()])

    ways = {"unpacked": partial(whole, False), "packed": partial(whole, True)}
    return {"version": gsplat.__version__} | {name: measure(way, repeats, model.device) for name, way in ways.items()}
