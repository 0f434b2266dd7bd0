"""Density control by squares with turnover: its settings, windows in which all pass its gates, what an event did."""

from __future__ import annotations

import torch
from helpers.optimizers import controlled, make_gaussians

from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step

SQUARES = {
    "choose_by": "squares",
    "prune_score_fraction": 0.05,
    "absgrad_threshold": 6e-4,
    "spare_beyond": 10.0,
    "final_keep": 1.0,
    "split": "long_axis",
}
"""Settings of `ErrorDrivenDensity`: growth drawn by squares, and each event first removes the 5 % of the least
squares."""

EVENT = Step(iteration=1200, total=5000, refine_until=3500, seed=3, scene_extent=2.0)


def event_at(iteration: int) -> Step:
    """The event of this iteration, a multiple of 100, in a run without an end."""
    return Step(iteration, 10**9, 10**9, seed=3, scene_extent=2.0)


def window(squares: list[float] | torch.Tensor, passing: float = 1.0) -> GaussianStats:
    """Statistics of Gaussians with these squares [N], all seen in one view, the first `passing` of them above the gate
    of the absolute gradient."""
    squares = torch.as_tensor(squares, dtype=torch.float32)
    stats = GaussianStats.zeros(len(squares), "cpu")
    for name in ("error_sums", "distance_sums", "weight_sums", "view_counts"):
        getattr(stats, name).fill_(1.0)
    stats.absgrad_sums[: round(passing * len(squares))] = 1e-3
    stats.square_sums[:] = squares
    return stats


def spread_squares(count: int, seed: int = 0) -> torch.Tensor:
    """[N] distinct squares of the size that a run has, over four decades, in no order."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return 1e-14 * 10 ** (4.0 * order / count)


def small_model(count: int) -> Gaussians:
    """float32, near the middle of the scene, opaque enough and small enough that only the order prunes."""
    gaussians = make_gaussians(count, dtype=torch.float32)
    gaussians.opacities.abs_()
    return gaussians


def event(gaussians: Gaussians, stats: GaussianStats, step: Step = EVENT, **settings) -> RowUpdate | None:
    """What an event of density control by squares changes after this window."""
    return controlled(gaussians, stats, **(SQUARES | settings)).update(gaussians, step)


def grown(update: RowUpdate) -> set[int]:
    """Rows that the event cloned or split."""
    sources = update.source.tolist()
    return {row for row in sources if sources.count(row) > 1}


def removed(update: RowUpdate | None, count: int) -> set[int]:
    """Rows that the event took away."""
    return set() if update is None else set(range(count)) - set(update.source.tolist())
