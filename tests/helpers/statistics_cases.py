"""What one pass adds to the statistics of density control on the renderer's worst inputs, on any device."""

from __future__ import annotations

import math

import torch
from helpers.raster_extremes import CASES, TWO_VIEWS, random_scene
from helpers.squares import event

from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.types import SH_C0, Cameras, Gaussians, GaussianStats

STIFF = ("needles of aspect 1e6", "gradients times 1e-15, squares below float32's range")
"""Cases of `helpers.statistics_errors` with bounds of their own."""

REACH = math.sqrt(2 * math.log(1 / DEFAULT_SETTINGS.alpha_min) / DEFAULT_SETTINGS.eps2d)
"""The longest gradient of a splat's exponent with respect to its mean, 1 / pixel: its distance is at most
sqrt(2 log(1 / alpha_min)) standard deviations, of at least sqrt(eps2d) pixels."""


def pass_statistics(
    gaussians: Gaussians, cameras: Cameras, device: str, size: float = 1.0
) -> tuple[GaussianStats, torch.Tensor]:
    """(statistics of one dense pass on the CPU, gradients [P, 3] of the colours: random, of about `size` / P)."""
    gaussians, cameras = gaussians.map(lambda value: value.float().to(device)), cameras.to(device)
    samples, stats = dense_samples(cameras), GaussianStats.zeros(len(gaussians), device)
    noise = torch.randn(len(samples), 3, generator=torch.Generator().manual_seed(0))
    gradients = (noise * (size / len(samples))).to(device)
    rendered = rasterize(gaussians, cameras, samples)
    screen = rendered.backward(gradients, torch.ones_like(rendered.alphas), with_statistics=True)
    screen.parameter_gradients(rows=False, stats=stats)
    return stats.map(torch.Tensor.cpu), gradients.cpu()


def share_of_bound(case: str, device: str) -> float:
    """The sum of all Gaussians' absolute gradients, over what the colours' gradients allow (docs/numerics.md).

    A pixel's slopes with respect to the exponents of all its splats sum up to at most its gradient's absolute sum times
    the largest colour; that times `REACH`, half the image's larger side and the number of views bounds the sum.
    """
    gaussians, cameras = CASES[case]
    gaussians = gaussians.map(torch.clone)
    gaussians.shN.zero_()  # so that colours are those of band 0
    stats, gradients = pass_statistics(gaussians, cameras, device)
    largest = float((0.5 + SH_C0 * gaussians.sh0).clamp(min=0).max())
    bound = 0.5 * len(cameras) * int(cameras.sizes.max()) * REACH * largest * float(gradients.abs().sum())
    return float(stats.absgrad_sums.double().sum()) / bound


def kept_by_a_finite_event(gaussians: Gaussians, stats: GaussianStats, **settings: float) -> set[int]:
    """The rows that an event after this window keeps, of a model that only the order prunes."""
    gaussians.opacities[:], gaussians.scales[:] = 1.0, -4.0
    update = event(gaussians, stats, **settings)
    assert update is not None and all(value.isfinite().all() for _, value in update.apply(gaussians).items())
    return set(update.source.tolist())


def assert_squares_that_overflow_are_survived(device: str) -> None:
    """Colours of 1e25: the squares are infinite, everything else is finite. Who has them stays, and the event is
    finite."""
    gaussians = random_scene(40)
    gaussians.sh0[:5] = 1e25
    stats, _ = pass_statistics(gaussians, TWO_VIEWS, device)
    infinite = ~stats.square_sums.isfinite()
    assert infinite[:5].any() and stats.weight_sums.isfinite().all()
    kept = kept_by_a_finite_event(gaussians, stats, prune_score_fraction=0.3)
    assert set(torch.nonzero(infinite).squeeze(-1).tolist()) <= kept
    assert len(kept) <= len(gaussians) - int(0.3 * int((~infinite).sum())) + 1


def assert_gradients_that_vanish_are_survived(device: str) -> None:
    """Gradients of 1e-25: every square rounds to 0, so nothing is removed and nobody grows."""
    gaussians = random_scene(40)
    stats, _ = pass_statistics(gaussians, TWO_VIEWS, device, size=1e-25)
    assert stats.weight_sums.max() > 0 and not stats.square_sums.any()
    gaussians.opacities[:], gaussians.scales[:] = 1.0, -4.0
    assert event(gaussians, stats) is None


def assert_gradients_that_overflow_are_survived(device: str) -> None:
    """Gradients of 1e38: no square is finite where there is a gradient, so none of these goes, and the event is
    finite."""
    gaussians = random_scene(40)
    stats, _ = pass_statistics(gaussians, TWO_VIEWS, device, size=1e38)
    drawn = stats.weight_sums > 0
    assert not stats.square_sums[drawn].isfinite().any() and stats.weight_sums.isfinite().all()
    kept = kept_by_a_finite_event(gaussians, stats, max_gaussians=50, prune_score_fraction=0.3)
    assert set(torch.nonzero(drawn).squeeze(-1).tolist()) <= kept


SURVIVED = (
    assert_squares_that_overflow_are_survived,
    assert_gradients_that_overflow_are_survived,
    assert_gradients_that_vanish_are_survived,
)
