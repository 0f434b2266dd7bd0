"""Errors of the rasterizer that runs here against the reference in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.bench.models import ring_cameras, surface_gaussians, tile_samples
from turbogs_plugin.engine.layout import ScreenRecord, columns
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.rendering import rasterize

COLUMNS = ("mean", "conic", "color", "opacity")
"""The columns that the records of screen gradients have in every pass."""

THRESHOLD = 1e-4
"""Differences beyond it are counted: a splat at a threshold is drawn by one and not by the other."""


def precision(device: torch.device) -> dict[str, float]:
    """Maximum and mean error of colours, share of samples beyond 1e-4, and relative L2 errors of screen gradients."""
    on_gpu = device.type == "cuda"
    count, size = (20_000, (320, 240)) if on_gpu else (2_000, (96, 64))
    model, cameras = surface_gaussians(count, device, seed=3), ring_cameras(3, *size, device)
    samples = tile_samples(cameras.sizes, 0.3, device, seed=4)
    upstream = torch.randn(len(samples), 3, device=device, generator=torch.Generator(device).manual_seed(5))
    ours = rasterize(model, cameras, samples)
    exact = rasterize_reference(model.map(Tensor.double), cameras.to(dtype=torch.float64), samples)
    difference = (ours.colors - exact.colors).abs()
    errors = {"gaussians": count, "forward_max": float(difference.max()), "forward_mean": float(difference.mean())}
    errors["forward_beyond_1e-4"] = float((difference.amax(dim=1) > THRESHOLD).double().mean())
    records, wanted = ours.backward(upstream).full_records(), exact.backward(upstream.double()).full_records()
    for name in COLUMNS:
        place = columns(ScreenRecord)[name]
        relative = (records[..., place] - wanted[..., place]).norm() / wanted[..., place].norm()
        errors[f"{name}_gradient"] = float(relative)
    return errors
