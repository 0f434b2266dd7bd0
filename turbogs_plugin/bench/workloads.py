"""Workloads that are timed: models brought to a wanted size, trainers of such models, samples of every tile."""

from __future__ import annotations

import math

import numpy as np
import torch
from gsplat.utils import normalized_quat_to_rotmat
from torch.nn.functional import normalize

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.scene import Scene
from turbogs_plugin.tiles import TILE_PIXELS, compact, pixel_table
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians, PixelSamples

PIXEL_BUDGET = 1.0
"""Pixels of an iteration in images (lambda): views times the sampling rate."""


def trainer_of(config: Config, scene: Scene, gaussians: Gaussians, device: torch.device) -> Trainer:
    """A trainer that starts from a copy of these Gaussians, and not from the points of the scene."""
    trainer = Trainer(config, scene, device)
    trainer.gaussians = gaussians.map(lambda value: value.clone())
    trainer.optimizer.setup(trainer.gaussians)
    trainer.density.setup(trainer.gaussians)
    trainer.initialise_maps()
    return trainer


def train(trainer: Trainer, iterations: int) -> None:
    """Train for this number of further iterations. Iterations lost to an overflow are repeated."""
    TrainingLoop(trainer).advance(trainer.iteration + iterations)


def resized(gaussians: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """A model that looks the same, with `count` Gaussians: a random subset, or all and jittered copies of random ones,
    which follow their original in memory. Surfaces stay covered, as standard deviations change with the number's root.
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


def tile_samples(sizes: np.ndarray, rate: float, device: torch.device, seed: int) -> PixelSamples:
    """floor(rate * 256) random pixels of every tile, in the order of samples."""
    count = max(1, int(rate * TILE_PIXELS))
    table = pixel_table(sizes, device)  # [T, 256]
    generator = torch.Generator(device).manual_seed(seed)
    keys = torch.rand(table.shape, device=device, generator=generator).masked_fill_(table < 0, -1.0)
    chosen = torch.zeros_like(table, dtype=torch.bool).scatter_(1, keys.topk(count, dim=1).indices, True)
    tiles = torch.arange(len(table), dtype=torch.int32, device=device)
    return compact(range(len(sizes)), sizes, table, chosen & (table >= 0), tiles, np.full(len(table), count))
