"""Rendering of sampled pixels and of whole images, by the engine of the Gaussians' device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.render_pass import Rendered, RenderOptions
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples


def rasterize(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, **options: Any) -> Rendered:
    """`Engine.render` by the engine of the Gaussians' device; `options` are the fields of `RenderOptions`."""
    return engine_of(gaussians.device).render(gaussians, cameras, samples, RenderOptions(**options))


def dense_samples(cameras: Cameras, view_ids: Sequence[int] | None = None) -> PixelSamples:
    """Every pixel of some views, as samples without empty slots.

    Args:
        cameras: all V cameras.
        view_ids: which of them; None for all.
    """
    view_ids = tuple(range(len(cameras)) if view_ids is None else view_ids)
    return dense_pixels(view_ids, cameras.sizes[list(view_ids)], cameras.viewmats.device)


@dataclass(frozen=True)
class RenderedImage:
    """A whole view.

    Args:
        colors: [H, W, 3], not clamped above.
        alphas: [H, W].
        depths: [H, W] expected depth along the camera's axis, in the unit of the means; 0 where nothing was hit. None
            if not asked for.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None


@torch.no_grad()
def render_image(gaussians: Gaussians, cameras: Cameras, view_id: int = 0, **options: Any) -> RenderedImage:
    """Render every pixel of one of the cameras; `options` are the fields of `RenderOptions`."""
    samples = dense_samples(cameras, [view_id])
    rendered = rasterize(gaussians, cameras.select([view_id]), samples, **options)
    width, height = cameras.sizes[view_id].tolist()
    places = samples.pixel_ids.long()

    def image(values: Tensor) -> Tensor:
        return torch.empty_like(values).index_copy_(0, places, values).reshape(height, width, *values.shape[1:])

    depths = None if rendered.depths is None else image(rendered.depths)
    return RenderedImage(image(rendered.colors), image(rendered.alphas), depths)
