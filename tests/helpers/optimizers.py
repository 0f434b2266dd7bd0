"""Models, gradients and statistics that the tests of optimizers and density control share."""

from __future__ import annotations

from dataclasses import fields

import torch
from helpers.models import random_gaussians
from torch import Tensor

from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.types import GaussianGradients, Gaussians, GaussianStats, Step

STEP = Step(iteration=100, total=5000, refine_until=3500, seed=7, scene_extent=2.0)


def make_gaussians(count: int, seed: int = 0, dtype=torch.float64) -> Gaussians:
    """Random Gaussians; band 0's first entry is the row number, so that rows can be recognised later."""
    gaussians = random_gaussians(count, 1, seed, dtype)
    gaussians.scales = 0.5 * gaussians.scales - 4
    gaussians.sh0[:, 0, 0] = torch.arange(count, dtype=dtype)
    return gaussians


def clone(gaussians: Gaussians) -> Gaussians:
    return gaussians.map(lambda value: value.clone())


def ready(optimizer, gaussians: Gaussians):
    """The optimizer, set up for these Gaussians."""
    optimizer.setup(gaussians)
    return optimizer


def make_gradients(views: int, count: int, seed: int = 1, dtype=torch.float64, size: float = 1e-5) -> GaussianGradients:
    """Random gradients of about `size` in every view, all Gaussians touched."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return size * torch.randn(*shape, generator=generator, dtype=dtype)

    return GaussianGradients(
        means=100 * normal(views, count, 3),
        quats=normal(views, count, 4),
        scales=10 * normal(views, count, 3),
        opacities=normal(views, count),
        sh0=normal(views, count, 1, 3),
        shN=normal(count, 3, 3),
        touched=torch.ones(count, dtype=torch.bool),
    )


def random_stats(count: int, seed: int, seen: float = 0.8) -> GaussianStats:
    """Statistics of a window in which about a share `seen` of the Gaussians was seen, some of them not in all terms."""
    generator = torch.Generator().manual_seed(seed)

    def uniform() -> Tensor:
        return torch.rand(count, generator=generator)

    weights = 5 * uniform() * (uniform() < seen)
    views = torch.randint(1, 9, (count,), generator=generator).float() * (weights > 0)
    return GaussianStats(
        error_sums=0.3 * uniform() * weights,
        distance_sums=(0.5 + uniform()) * weights,
        weight_sums=weights,
        grad_sums=4e-4 * uniform() * views,
        absgrad_sums=8e-4 * uniform() * views,
        square_sums=1e-6 * uniform() * weights,
        view_counts=views,
        max_radii=0.2 * uniform(),
    )


def busy_stats(count: int) -> GaussianStats:
    """Every Gaussian seen, equally difficult, and passing the gradient threshold."""
    stats = GaussianStats.zeros(count, "cpu")
    for name in ("error_sums", "distance_sums", "weight_sums", "grad_sums", "view_counts"):
        getattr(stats, name).fill_(1.0)
    return stats


def fill(target: GaussianStats, source: GaussianStats) -> None:
    """Write statistics into a controller's window."""
    for field in fields(source):
        getattr(target, field.name).copy_(getattr(source, field.name))


def controlled(gaussians: Gaussians, stats: GaussianStats | None = None, **config) -> ErrorDrivenDensity:
    """A controller of these Gaussians, with these statistics in its window."""
    density = ErrorDrivenDensity(**config)
    density.setup(gaussians)
    if stats is not None:
        fill(density.stats, stats)
    return density


def all_finite(gaussians: Gaussians) -> bool:
    return all(bool(torch.isfinite(value).all()) for _, value in gaussians.items())


def equal(one: Gaussians, other: Gaussians) -> bool:
    """To the last bit."""
    return all(torch.equal(value, getattr(other, name)) for name, value in one.items())
