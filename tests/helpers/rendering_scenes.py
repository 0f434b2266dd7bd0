"""Small scenes that the tests of the rasterizers share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from helpers.models import random_gaussians
from torch import Tensor

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.tiles import compact, pixel_table
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples


def make_cameras(sizes: list[tuple[int, int]], dtype=torch.float64, distance: float = 4.0) -> Cameras:
    """Cameras on an arc that look at the origin; principal points off the centre."""
    viewmats, intrinsics = [], []
    for index, (width, height) in enumerate(sizes):
        angle = 0.5 * index - 0.3
        position = distance * torch.tensor([math.sin(angle), 0.2 * index, -math.cos(angle)], dtype=torch.float64)
        forward = -position / position.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        viewmats.append(viewmat)
        focal = 0.9 * max(width, height)
        intrinsics.append([[focal, 0, 0.53 * width], [0, 1.1 * focal, 0.46 * height], [0, 0, 1]])
    return Cameras(
        torch.stack(viewmats).to(dtype),
        torch.tensor(intrinsics, dtype=dtype),
        np.array(sizes, dtype=np.int64).reshape(-1, 2),
    )


def make_gaussians(count: int, seed: int = 0, dtype=torch.float64, degree: int = 3, spread: float = 1.0) -> Gaussians:
    """Gaussians about the origin, of mixed sizes, shapes and opacities."""
    gaussians = random_gaussians(count, degree, seed, torch.float64)
    gaussians.means, gaussians.scales = spread * gaussians.means, -1.8 + 0.7 * gaussians.scales
    gaussians.opacities, gaussians.shN = 0.5 + 1.5 * gaussians.opacities, 0.2 * gaussians.shN
    return gaussians.map(lambda value: value.to(dtype))


def dense_on_grid(sizes: np.ndarray, origin: tuple[int, int]) -> PixelSamples:
    """Every pixel of images of these sizes, by the tiles of a grid that begins elsewhere."""
    table = pixel_table(sizes, "cpu", origin)
    exist = table >= 0
    tile_ids = torch.arange(len(table), dtype=torch.int32)
    counts = exist.sum(dim=1).numpy()
    return compact(tuple(range(len(sizes))), sizes, table, exist, tile_ids, counts, full=True, origin=origin)


def thin_out(samples: PixelSamples, rate: float, seed: int = 0, empty_slots: int = 0) -> PixelSamples:
    """Keep a share of each tile's samples, in order; leave some tiles out altogether; add empty slots at tile ends."""
    generator = np.random.default_rng(seed)
    pixels, tiles, counts = [], [], []
    offsets = samples.tile_offsets.tolist()
    for tile, first, last in zip(samples.tile_ids.tolist(), offsets[:-1], offsets[1:], strict=True):
        if len(offsets) > 4 and generator.random() < 0.15:
            continue
        kept = np.sort(generator.permutation(last - first)[: max(1, int(rate * (last - first)))]) + first
        pixels += [samples.pixel_ids.numpy()[kept], np.full(empty_slots, -1, np.int32)]
        tiles.append(tile)
        counts.append(len(kept) + empty_slots)
    return PixelSamples(
        samples.view_ids,
        samples.sizes,
        torch.from_numpy(np.concatenate(pixels).astype(np.int32)),
        torch.tensor(tiles, dtype=torch.int32),
        torch.tensor([0, *np.cumsum(counts)], dtype=torch.int32),
        origin=samples.origin,
    )


def stacked_splats(z: Tensor) -> tuple[Gaussians, Cameras, PixelSamples]:
    """One tile that every splat reaches, in one view, so that depths are the z of the means: [N]."""
    count = len(z)
    gaussians, cameras = make_gaussians(count, dtype=torch.float32), make_cameras([(2, 2)], torch.float32)
    cameras.viewmats[0] = torch.eye(4)
    cameras.Ks[0, :2, 2] = 1.0
    gaussians.means = torch.stack([torch.zeros(count), torch.zeros(count), z], dim=1)
    gaussians.scales[:], gaussians.opacities[:] = 0.1 * z.log()[:, None] - 1, 1.0
    return gaussians, cameras, dense_samples(cameras)


def one_tile_of_a_wide_image() -> tuple[Gaussians, Cameras, PixelSamples]:
    """One active tile of a wide image, which every splat covers."""
    gaussians, cameras = make_gaussians(60, dtype=torch.float32), make_cameras([(4096, 4096)], torch.float32)
    gaussians.scales[:], gaussians.opacities[:] = 2.0, 1.0
    samples = dense_samples(cameras)
    samples = replace(
        samples,
        tile_ids=samples.tile_ids[5000:5001],
        pixel_ids=samples.pixel_ids[5000 * 256 : 5001 * 256],
        tile_offsets=samples.tile_offsets[:2],
    )
    return gaussians, cameras, samples
