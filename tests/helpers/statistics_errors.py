"""Errors of density control's statistics against float64, on mild and stiff cases; docs/lab/numerics.py prints them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from helpers.synthetic_capture import ring_cameras, surface_gaussians
from torch import Tensor

from turbogs_plugin.bench.workloads import tile_samples
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.render import rasterize
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, PixelSamples

COUNT, SIZE, VIEWS, RATE = 2_000, (96, 64), 3, 0.5
"""Gaussians, (width, height) of a view, views, and the share of the pixels that is sampled, of every case."""

TURNOVER = 0.05
"""Share of the Gaussians that an event of density control removes."""

SUMS = ("weight_sums", "absgrad_sums", "square_sums")
"""Statistics that decide which Gaussians go, how many grow, and which."""

LOOKS, ROWS = 12_800, 10_000
"""Views of the window whose sums are measured, 100 iterations of 128, and its Gaussians."""


@dataclass(frozen=True)
class StatisticsCase:
    """A model, and the gradients that come from above."""

    name: str
    change: Callable[[Gaussians], object] = lambda gaussians: None  # of `surface_gaussians`' model, in place
    gradient: float = 1.0  # size of the colours' gradients times the number of samples


CASES = (
    StatisticsCase("ordinary"),
    StatisticsCase("needles of aspect 1e6", lambda g: g.scales.copy_(torch.tensor([1.0, -12.8, -12.8]))),
    StatisticsCase("points, below the low-pass filter", lambda g: g.scales.fill_(-12.0)),
    StatisticsCase("faint: opacity 1 / 250", lambda g: g.opacities.fill_(-5.5)),
    StatisticsCase("opaque: alpha up to 0.999, many layers", lambda g: (g.opacities.fill_(6.9), g.scales.add_(1.0))),
    StatisticsCase("one colour: slopes cancel", lambda g: (g.sh0.fill_(1.0), g.shN.zero_())),
    StatisticsCase("colours of 1e6", lambda g: g.sh0.mul_(1e6)),
    StatisticsCase("gradients times 1e-6", gradient=1e-6),
    StatisticsCase("gradients times 1e-15, squares below float32's range", gradient=1e-15),
    StatisticsCase("gradients times 1e15", gradient=1e15),
)


@dataclass(frozen=True)
class StatisticsErrors:
    """Errors of one case.

    Single sums of squares are those of the Gaussians with at least 1e-4 of the mean sum; a draw's chances are off by as
    much. `exchanged`: of the 5 % of the least sums of squares, the share that float64 has not among them, over the
    Gaussians with a sum, as equal ones are not removed.
    """

    case: str
    errors: dict[str, float]  # name of a sum -> L2 of the difference over L2
    median_square: float  # relative
    worst_square: float
    exchanged: float


def least_squares(square_sums: Tensor) -> Tensor:
    """[N] bool: the 5 % with the least sums [N]."""
    chosen = torch.zeros_like(square_sums, dtype=torch.bool)
    chosen[square_sums.argsort(stable=True)[: math.floor(TURNOVER * len(square_sums))]] = True
    return chosen


def compared(case: str, given: GaussianStats, exact: GaussianStats) -> StatisticsErrors:
    """Errors of sums [N] in float32 against those in float64."""
    errors = {}
    for name in SUMS:
        got, wanted = getattr(given, name).double().cpu(), getattr(exact, name).double().cpu()
        errors[name] = float((got - wanted).norm() / wanted.norm().clamp(min=torch.finfo(torch.float64).tiny))
    got, wanted = given.square_sums.double().cpu(), exact.square_sums.double().cpu()
    counts = wanted > 1e-4 * wanted.mean()
    relative = ((got - wanted).abs() / wanted)[counts]
    seen = wanted > 0
    removed, kept = least_squares(got[seen]), ~least_squares(wanted[seen])
    exchanged = float((removed & kept).sum() / removed.sum().clamp(min=1))
    return StatisticsErrors(case, errors, float(relative.median()), float(relative.max()), exchanged)


def statistics_of(
    gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, gradients: Tensor, exact: bool
) -> GaussianStats:
    """The statistics of one pass with these gradients [P, 3] of the colours.

    Args:
        exact: by the reference in float64, its sums kept in float64; else by the engine of the device in float32.
    """
    stats = GaussianStats.zeros(len(gaussians), gaussians.device)
    if exact:
        gaussians, gradients = gaussians.map(Tensor.double), gradients.double()
        cameras, stats = cameras.to(dtype=torch.float64), stats.map(Tensor.double)
    render = rasterize_reference if exact else rasterize
    errors = torch.ones_like(gradients[:, 0])
    screen = render(gaussians, cameras, samples).backward(gradients, errors, with_statistics=True)
    screen.parameter_gradients(rows=False, stats=stats)
    return stats


def measure_case(case: StatisticsCase, device: torch.device) -> StatisticsErrors:
    """One pass of a case."""
    gaussians, cameras = surface_gaussians(COUNT, device, seed=3), ring_cameras(VIEWS, *SIZE, device)
    case.change(gaussians)
    samples = tile_samples(cameras.sizes, RATE, device, seed=4)
    noise = torch.randn(len(samples), 3, generator=torch.Generator().manual_seed(5)).to(device)
    inputs = (gaussians, cameras, samples, noise * (case.gradient / len(samples)))
    return compared(case.name, statistics_of(*inputs, exact=False), statistics_of(*inputs, exact=True))


def measure_window(device: torch.device, looks: int | None = None) -> StatisticsErrors:
    """The sums of `looks` views (None: `LOOKS`): squares over eight decades, added one by one in float32."""
    generator = torch.Generator().manual_seed(6)
    level = 10 ** (8 * torch.rand(ROWS, generator=generator, dtype=torch.float64) - 18)
    given, exact = GaussianStats.zeros(ROWS, device), GaussianStats.zeros(ROWS, "cpu").map(Tensor.double)
    looks = looks or LOOKS
    for _ in range(looks):
        look = (level * torch.rand(ROWS, generator=generator, dtype=torch.float64)).float()
        for name in SUMS:
            getattr(given, name).add_(look.to(device))
            getattr(exact, name).add_(look)
    return compared(f"window of {looks} looks", given, exact)
