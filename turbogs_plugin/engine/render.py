"""Rendering of sampled pixels and of whole images, by the engine of the Gaussians' device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows
from turbogs_plugin.engine.render_pass import Rendered, RenderOptions
from turbogs_plugin.errors import InputError
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples


def rasterize(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, **options: Any) -> Rendered:
    """`Engine.render` by the engine of the Gaussians' device; `options` are the fields of `RenderOptions`. Raises
    `InputError`: cameras of other views than the samples', or Gaussians in half precision or with gradients wanted."""
    rows, views = cameras.by_row()[2], samples.view_ids
    if len(rows) != len(views) or (isinstance(rows, tuple) and sorted(rows) == sorted(views) and rows != views):
        raise InputError(f"cameras are of views {list(rows)}, samples of {list(views)}: give cameras.select(view_ids)")
    if gaussians.means.dtype not in (torch.float32, torch.float64):
        raise InputError(f"means are of {gaussians.means.dtype}: give float32, by gaussians.map(torch.Tensor.float)")
    if torch.is_grad_enabled() and any(value.requires_grad for _, value in gaussians.items()):
        raise InputError("rasterize makes no graph: render under torch.no_grad(), or by rasterize_differentiable")
    return engine_of(gaussians.device).render(gaussians, cameras, samples, RenderOptions(**options))


def dense_samples(cameras: Cameras, view_ids: Sequence[int] | None = None) -> PixelSamples:
    """Every pixel of some of the cameras' views, None for all, as samples without empty slots."""
    view_ids = tuple(range(len(cameras)) if view_ids is None else view_ids)
    return dense_pixels(view_ids, cameras.sizes[list(view_ids)], cameras.viewmats.device)


@dataclass(frozen=True)
class RenderedImage:
    """A whole view.

    Args:
        colors: [H, W, 3], not clamped above.
        alphas: [H, W].
        depths: [H, W] expected, along the camera's axis, in the means' unit; 0 where nothing was hit. None: not asked.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None


@torch.no_grad()
def render_image(
    gaussians: Gaussians, cameras: Cameras, view_id: int = 0, antialiased: bool = False, **options: Any
) -> RenderedImage:
    """Render every pixel of one of the cameras; `options` are the fields of `RenderOptions`. `antialiased`: as gsplat's
    mode of that name, in which a splat is the less opaque, the more `eps2d` adds to it."""
    samples, camera = dense_samples(cameras, [view_id]), cameras.select([view_id])
    if antialiased:
        settings = RenderOptions(**options).settings
        rows = drawable_rows(gaussians, camera, settings)
        shares = rows.scatter(project_rows(rows, rows.take(gaussians), camera, 0, settings).shares)[0]
        gaussians = replace(gaussians, opacities=torch.logit(torch.sigmoid(gaussians.opacities) * shares))
    rendered = rasterize(gaussians, camera, samples, **options)
    (width, height), places = cameras.sizes[view_id].tolist(), samples.pixel_ids.long()

    def image(values: Tensor) -> Tensor:
        return torch.empty_like(values).index_copy_(0, places, values).reshape(height, width, *values.shape[1:])

    depths = None if rendered.depths is None else image(rendered.depths)
    return RenderedImage(image(rendered.colors), image(rendered.alphas), depths)
