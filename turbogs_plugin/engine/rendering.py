"""Rendering at sampled pixels and of whole images, by the engine of the Gaussians' device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, RasterSettings, Rendered, ScreenGradients
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

__all__ = [
    "DEFAULT_SETTINGS",
    "RasterSettings",
    "Rendered",
    "RenderedImage",
    "ScreenGradients",
    "dense_samples",
    "rasterize",
    "rasterize_reference",
    "render_image",
]


def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    *,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    with_depth: bool = False,
) -> Rendered:
    """Render samples of K views by the engine of the Gaussians' device; see `Engine.render`."""
    return engine_of(gaussians.device).render(
        gaussians, cameras, samples, sh_degree=sh_degree, settings=settings, with_depth=with_depth
    )


def dense_samples(cameras: Cameras, view_ids: Sequence[int] | None = None) -> PixelSamples:
    """Every pixel of every tile of some views, in cell order, without empty slots.

    Args:
        cameras: all V cameras.
        view_ids: which of them; all where None.
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
            where not asked for.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None


@torch.no_grad()
def render_image(
    gaussians: Gaussians,
    cameras: Cameras,
    view_id: int = 0,
    *,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    with_depth: bool = False,
) -> RenderedImage:
    """Every pixel of one of the cameras; the other arguments are those of `Engine.render`."""
    samples = dense_samples(cameras, [view_id])
    rendered = rasterize(
        gaussians, cameras.select([view_id]), samples, sh_degree=sh_degree, settings=settings, with_depth=with_depth
    )
    width, height = cameras.sizes[view_id].tolist()
    places = samples.pixel_ids.long()

    def image(values: Tensor) -> Tensor:
        return torch.empty_like(values).index_copy_(0, places, values).reshape(height, width, *values.shape[1:])

    depths = None if rendered.depths is None else image(rendered.depths)
    return RenderedImage(image(rendered.colors), image(rendered.alphas), depths)
