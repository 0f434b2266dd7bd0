"""Rendering at sampled pixels and of whole images, by the engine of the Gaussians' device."""

from __future__ import annotations

from collections.abc import Sequence

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
    "ScreenGradients",
    "dense_samples",
    "rasterize",
    "rasterize_reference",
    "render_images",
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


@torch.no_grad()
def render_images(
    gaussians: Gaussians,
    cameras: Cameras,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
) -> list[tuple[Tensor, Tensor]]:
    """Whole images, view after view so that memory does not grow with their number.

    Returns:
        For each camera the colours [H, W, 3], not clamped above, and alphas [H, W].
    """
    images = []
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        samples = dense_samples(cameras, [view])
        rendered = rasterize(gaussians, cameras.select([view]), samples, sh_degree=sh_degree, settings=settings)
        places = samples.pixel_ids.long()
        colors = torch.empty_like(rendered.colors).index_copy_(0, places, rendered.colors)
        alphas = torch.empty_like(rendered.alphas).index_copy_(0, places, rendered.alphas)
        images.append((colors.reshape(height, width, 3), alphas.reshape(height, width)))
    return images
