"""The Gaussians that training starts from: one for each point of the capture, and a backdrop behind them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import mean_neighbor_distances
from turbogs_plugin.types import SH_C0, Gaussians

DARKEST = 0.5
"""Smallest channel of a new Gaussian's colour, out of 255: at exactly 0 the clamp of colours may zero its gradient."""
SMALLEST_SCALE = 1e-4
"""Smallest scale of a new Gaussian, in extents: coincident points give none."""
BACKDROP_COUNT, BACKDROP_RADIUS, BACKDROP_OPACITY = 3000, 20.0, 0.88
"""Gaussians of the backdrop: 3.7 degrees apart; their distance in extents, behind everything in a capture and near
enough for float32; their opacity, where several cover each direction, so that nothing shines through."""


def gaussians_from_points(
    points: Tensor, colors: Tensor, sh_degree: int, extent: float, opacity: float = 0.1, size: float = 1.0
) -> Gaussians:
    """One isotropic Gaussian for each point [M, 3], M >= 2, as 3DGS starts (Kerbl et al. 2023, section 5.1).

    Its scale is `size` times the mean distance to the three nearest points, at least `SMALLEST_SCALE` extents. Its
    colour is the point's ([M, 3] uint8); channels of 0 become `DARKEST`. Harmonics are zero up to `sh_degree`.
    Raises `InputError` for fewer than two points."""
    count = len(points)
    if count < 2:
        raise InputError(f"there are too few points to start from: {count}")
    scales = (size * mean_neighbor_distances(points, neighbors=3)).clamp(min=SMALLEST_SCALE * extent).log()
    return Gaussians(
        means=points.clone(),
        quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=scales[:, None].repeat(1, 3),
        opacities=points.new_full((count,), math.log(opacity / (1.0 - opacity))),
        sh0=((colors.to(points).clamp(min=DARKEST) / 255.0 - 0.5) / SH_C0)[:, None, :],
        shN=points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def backdrop_gaussians(color: Tensor, sh_degree: int, extent: float) -> Gaussians:
    """A sphere of one colour ([3] float, 0 .. 1) around the scene and all cameras, seen where the model has nothing
    else, which would be black. Its Gaussians lie on a Fibonacci lattice and train like all others."""
    index = torch.arange(BACKDROP_COUNT, dtype=torch.float64) + 0.5
    height = 1.0 - 2.0 * index / BACKDROP_COUNT
    angle = index * math.pi * (1.0 + math.sqrt(5.0))
    ring = (1.0 - height * height).sqrt()
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1).float()
    colors = (color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).expand(BACKDROP_COUNT, 3)
    return gaussians_from_points(directions * BACKDROP_RADIUS * extent, colors, sh_degree, extent, BACKDROP_OPACITY)


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The model with room for exactly this degree: higher bands are dropped, missing ones are zero."""
    bands = (degree + 1) ** 2 - 1
    missing = gaussians.shN.new_zeros(len(gaussians), max(0, bands - gaussians.shN.shape[1]), 3)
    return replace(gaussians, shN=torch.cat([gaussians.shN[:, :bands], missing], dim=1))
