"""What is timed: a trained model brought to a wanted size, or a synthetic one with synthetic cameras."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import numpy as np
import torch
from gsplat.utils import normalized_quat_to_rotmat
from torch.nn.functional import normalize

from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.model.row_order import spatial_order
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.tiles import TILE_PIXELS, compact, pixel_table
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

TRAINING_ITERATIONS = 1500
"""How long a model is trained before it is timed, unless something else is asked for."""

RING_RADIUS = 3.0
"""Distance of the synthetic cameras from the vertical axis."""

GROWING_SHARE = 0.8
"""Share of a model's training in which it grows; in the rest it settles at its final size."""


def trained_model(
    scene: Scene, count: int, iterations: int, device: torch.device, overrides: Sequence[str]
) -> Gaussians:
    """A model of `count` Gaussians, trained briefly.

    It grows by density control, to at most `count`, is brought to the exact size by `resized`, and settles without
    density control.

    Args:
        iterations: in all; 0: the initial model, resized.
        overrides: of the configuration.
    """
    growing = max(1, round(GROWING_SHARE * iterations))
    lengths = [f"train.iterations={growing}", f"train.refine_until={round(0.9 * growing)}"]
    lengths += [f"train.sh_interval={max(1, growing // 5)}", "density.type=error_driven"]
    config = load_config("turbogs", [*overrides, *lengths, f"density.max_gaussians={count}"]).without_plan()
    print(f"trains a model of {count} Gaussians for {iterations} iterations on the {device.type}", file=sys.stderr)
    trainer = Trainer(config, scene, device)
    if iterations:
        train(trainer, growing)
    settling = config.changed(train={"sh_interval": 1}, density={"type": "none"})
    trainer = trainer_of(settling, scene, resized(trainer.gaussians, count), device)
    train(trainer, iterations - growing)
    return trainer.gaussians


def trainer_of(config: Config, scene: Scene, gaussians: Gaussians, device: torch.device, ranks: Ranks = ONE) -> Trainer:
    """A trainer that starts from a copy of these Gaussians, and not from the points of the scene."""
    trainer = Trainer(config, scene, device, engine=ranks.engine(device))
    trainer.begin_with(gaussians.map(lambda value: value.clone()))
    trainer.initialise_maps()
    return trainer


def train(trainer: Trainer, iterations: int) -> None:
    """Train for so many more iterations. Iterations that were lost to an overflow are repeated."""
    TrainingLoop(trainer).advance(trainer.iteration + iterations)


def resized(gaussians: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """A model that looks the same, with `count` Gaussians: a random subset, or all and jittered copies of random ones.

    Standard deviations change with the inverse root of the number, so that surfaces stay covered as they were. Copies
    follow their original in memory.
    """
    present = len(gaussians)
    generator = torch.Generator().manual_seed(seed)
    if count <= present:
        source = torch.randperm(present, generator=generator)[:count]
        shrink = torch.full((count,), math.sqrt(count / present))
    else:
        extra = torch.randint(present, (count - present,), generator=generator)
        source = torch.cat([torch.arange(present), extra])
        shrink = source.bincount(minlength=present)[source].sqrt()
    order = source.argsort(stable=True)
    source, shrink = source[order].to(gaussians.device), shrink[order].to(gaussians.device)
    result = gaussians.map(lambda value: value[source])
    axes = normalized_quat_to_rotmat(normalize(result.quats, dim=-1)) * result.scales.exp()[:, None, :]  # [M, 3, 3]
    noise = torch.randn(count, 3, 1, generator=generator).to(axes)
    result.means = result.means + torch.where((shrink > 1)[:, None], (axes @ noise)[:, :, 0], 0.0)
    result.scales = result.scales - shrink.log()[:, None]
    return result


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


def tile_samples(sizes: np.ndarray, rate: float, device: torch.device, seed: int) -> PixelSamples:
    """floor(rate * 256) random pixels of every tile, in the order of samples."""
    count = max(1, int(rate * TILE_PIXELS))
    table = pixel_table(sizes, device)  # [T, 256]
    generator = torch.Generator(device).manual_seed(seed)
    keys = torch.rand(table.shape, device=device, generator=generator).masked_fill_(table < 0, -1.0)
    chosen = torch.zeros_like(table, dtype=torch.bool).scatter_(1, keys.topk(count, dim=1).indices, True)
    tiles = torch.arange(len(table), dtype=torch.int32, device=device)
    return compact(range(len(sizes)), sizes, table, chosen & (table >= 0), tiles, np.full(len(table), count))
