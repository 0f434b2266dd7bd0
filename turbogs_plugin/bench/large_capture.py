"""A capture of any size that needs no disk: synthetic Gaussians, photographed by the renderer."""

from __future__ import annotations

import numpy as np
import torch

from turbogs_plugin.bench.models import ring_cameras, surface_gaussians
from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import SH_C0, Cameras

POINT_NOISE = 0.01
"""Standard deviation of the points' noise; the cameras are 3 from the centre."""
PIXELS_PER_GAUSSIAN, FEWEST_GAUSSIANS = 40, 100
EXTENT_MARGIN, TEST_EVERY = 1.1, 8
"""As in 3DGS."""


@torch.no_grad()
def synthetic_scene(views: int, width: int, height: int, device: torch.device, gaussians: int | None = None) -> Scene:
    """A scene whose photos are renders of `surface_gaussians`, in host memory.

    Args:
        views: photos in all, from a ring of cameras; every eighth one tests.
        width, height: of each.
        device: where to render them.
        gaussians: of the model that is photographed; one for `PIXELS_PER_GAUSSIAN` of a photo where None. A quarter of
            them are the points of the reconstruction.
    """
    model = surface_gaussians(gaussians or max(FEWEST_GAUSSIANS, width * height // PIXELS_PER_GAUSSIAN), device)
    cameras = ring_cameras(views, width, height, device)
    test = np.arange(views) % TEST_EVERY == 0

    def photograph(chosen: np.ndarray) -> PosedImages:
        pixels = torch.empty(len(chosen), height, width, 3, dtype=torch.uint8)
        for place, view in enumerate(chosen.tolist()):
            image = render_image(model, cameras, view)
            pixels[place].copy_((image.colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8))
        part = Cameras(cameras.viewmats[chosen].cpu(), cameras.Ks[chosen].cpu(), cameras.sizes[chosen])
        return PosedImages(part, tuple(f"view-{view:04d}" for view in chosen), Photos(pixels.view(-1, 3), part.sizes))

    generator = torch.Generator().manual_seed(0)
    means = model.means[::4].cpu()
    centers = cameras.centers.cpu()[torch.from_numpy(~test)]
    return Scene(
        name=f"synthetic-{views}x{width}x{height}",
        train=photograph(np.flatnonzero(~test)),
        test=photograph(np.flatnonzero(test)),
        points=means + POINT_NOISE * torch.randn(means.shape, generator=generator),
        point_colors=((SH_C0 * model.sh0[::4, 0].cpu() + 0.5).clamp(0.0, 1.0) * 255.0).to(torch.uint8),
        frame=Frame(np.zeros(3), 1.0),
        extent=EXTENT_MARGIN * float((centers - centers.mean(dim=0)).norm(dim=1).max()),
    )
