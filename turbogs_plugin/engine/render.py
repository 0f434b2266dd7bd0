"""Rendering of sampled pixels and of whole images, by the engine of the Gaussians' device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows
from turbogs_plugin.engine.render_pass import Rendered, RenderOptions
from turbogs_plugin.errors import InputError
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples
from turbogs_plugin.types.gaussians import ROW_SHAPES


def rasterize(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, **options: Any) -> Rendered:
    """`Engine.render` by the engine of the Gaussians' device; `options` are the fields of `RenderOptions`. Raises
    `InputError`: cameras of another number, order or image size than the samples' views, Gaussians of other shapes or
    types, or with gradients wanted. Cameras that were not selected by number are taken for those of the views."""
    rows, views = cameras.by_row()[2], samples.view_ids
    if len(rows) != len(views) or (isinstance(rows, tuple) and sorted(rows) == sorted(views) and rows != views):
        raise InputError(f"cameras are of views {list(rows)}, samples of {list(views)}: give cameras.select(view_ids)")
    if not np.array_equal(cameras.sizes, samples.sizes):
        raise InputError(f"cameras have sizes {cameras.sizes.tolist()}, samples {samples.sizes.tolist()}")
    _require_model(gaussians, cameras)
    if torch.is_grad_enabled() and any(value.requires_grad for _, value in gaussians.items()):
        raise InputError("rasterize makes no graph: render under torch.no_grad(), or by rasterize_differentiable")
    return engine_of(gaussians.device).render(gaussians, cameras, samples, RenderOptions(**options))


def _require_model(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raise `InputError` unless parameters have their shapes and, as the cameras, one type of a kernel's."""
    count, kind = len(gaussians), gaussians.means.dtype
    if kind not in (torch.float32, torch.float64):
        raise InputError(f"means are of {kind}: give float32, by gaussians.map(torch.Tensor.float)")
    for name, value in gaussians.items():
        shape = (count, *ROW_SHAPES.get(name, (*value.shape[1:2], 3)))
        if tuple(value.shape) != shape or value.dtype != kind:
            raise InputError(f"{name} is {tuple(value.shape)} of {value.dtype}: expected {shape} of {kind}, as means")
    if (own := cameras.by_row()[0].dtype) != kind:
        raise InputError(f"cameras are of {own}, Gaussians of {kind}: give cameras.to(dtype={kind})")


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
