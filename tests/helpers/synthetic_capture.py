"""Captures of any size that need no disk: synthetic Gaussians, photographed by the renderer."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn.functional import normalize

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.model.row_order import spatial_order
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import SH_C0, Cameras, Gaussians

RING_RADIUS = 3.0  # distance of the cameras from the vertical axis
POINT_NOISE = 0.01  # standard deviation
EXTENT_MARGIN, TEST_EVERY = 1.1, 8  # 3DGS's


def ring_cameras(count: int, width: int, height: int, device: torch.device) -> Cameras:
    """Cameras on a ring that look at the origin."""
    origin, up = np.zeros(3), np.array([0.0, -1.0, 0.0])
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    positions = [np.array([RING_RADIUS * math.sin(a), -0.6, -RING_RADIUS * math.cos(a)]) for a in angles]
    viewmats = [look_at(position, origin, up) for position in positions]
    focal = 0.9 * max(width, height)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    sizes = np.array([[width, height]] * count, dtype=np.int64)
    return Cameras(torch.from_numpy(np.stack(viewmats)).float(), intrinsics.repeat(count, 1, 1), sizes).to(device)


def surface_gaussians(count: int, device: torch.device, seed: int = 0) -> Gaussians:
    """Flat Gaussians on a sphere, on the ground below it and on a far shell, about as large as their spacing."""
    generator = torch.Generator().manual_seed(seed)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=1)
    means = directions.clone()
    third = count // 3
    ground = 6 * torch.rand(third, 2, generator=generator) - 3
    means[:third] = torch.stack([ground[:, 0], torch.full((third,), 1.0), ground[:, 1]], dim=1)
    means[third : 2 * third] = 8 * directions[third : 2 * third]
    spacing = torch.full((count,), math.sqrt(4 * math.pi / third))
    spacing[:third] = math.sqrt(36 / third)
    spacing[third : 2 * third] *= 8
    scales = spacing.log()[:, None] + 0.5 * torch.randn(count, 3, generator=generator) - 0.3
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=generator),
        scales=scales,
        opacities=2 * torch.randn(count, generator=generator),
        sh0=torch.randn(count, 1, 3, generator=generator),
        shN=0.1 * torch.randn(count, 15, 3, generator=generator),
    )
    order = spatial_order(means, RING_RADIUS)  # as a trained model has them
    return gaussians.map(lambda value: value[order].to(device))


@torch.no_grad()
def synthetic_scene(views: int, width: int, height: int, device: torch.device, gaussians: int) -> Scene:
    """A scene in host memory, whose photos, every eighth of which tests, are renders on the device of
    `surface_gaussians`; a quarter of these are the points of the reconstruction."""
    model = surface_gaussians(gaussians, device)
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
