"""How many iterations fit into a time.

The cost of an iteration is ``base + per_gaussian * N``. If fewer iterations fit than are configured, the run is that
much shorter; if they would be fewer than `FEWEST_SHARE` of the configured ones, the number of Gaussians is lowered. If
more fit than are configured, and than `train.epochs` take, an iteration gets more pixels
(`turbogs_plugin.plan.pixels`) until these fill the time. Only then are there more iterations, as those overfit the
photos (docs/budgets.md). This is the plan before a run; while it trains, `turbogs_plugin.train.pace.TimePace` measures
the cost and corrects the number of iterations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from turbogs_plugin.plan.caps import expected_gaussians

FEWEST_SHARE = 0.3
"""Least share of the configured iterations; instead of fewer, the run gets fewer Gaussians."""


@dataclass(frozen=True)
class IterationCost:
    """Seconds of an iteration with N Gaussians: ``base + per_gaussian * N``."""

    base: float
    per_gaussian: float

    @classmethod
    def through(cls, small: tuple[int, float], large: tuple[int, float]) -> IterationCost:
        """The line through two measurements (Gaussians, seconds); neither part is negative."""
        (few, seconds_few), (many, seconds_many) = small, large
        slope = (seconds_many - seconds_few) / max(1, many - few)
        slope = min(max(0.0, slope), seconds_many / max(1, many))
        return cls(seconds_many - slope * many, slope)

    def at(self, gaussians: float) -> float:
        return self.base + self.per_gaussian * gaussians


def fit_to_time(
    seconds: float,
    cost: IterationCost,
    initial: int,
    cap: int,
    iterations: int,
    refine_share: float,
    keeps_cap: bool = True,
) -> tuple[int, int]:
    """How long a schedule, and how many Gaussians, before training.

    Args:
        seconds: left for iterations.
        initial: Gaussians at the start; their number is expected to rise along a line until the end of density control,
            to `expected_gaussians`.
        cap: most Gaussians at the end; 0: none.
        iterations: configured.
        refine_share: of the iterations, those with density control.
        keeps_cap: whether the density control would keep a smaller cap.

    Returns:
        (iterations, cap): the cap is the given one where at least `FEWEST_SHARE` of the configured iterations fit, or
        where no other would be kept.
    """
    growing = 0.5 * refine_share  # share of the run that the initial number counts for

    def mean(final: float) -> float:
        return growing * initial + (1.0 - growing) * final

    final = expected_gaussians(initial, cap)
    fitting = seconds / max(1e-9, cost.at(mean(final)))
    fewest = FEWEST_SHARE * iterations
    if fitting >= fewest or not keeps_cap:
        return max(1, int(fitting)), cap
    if cost.per_gaussian > 0:
        wanted = (seconds / fewest - cost.base) / cost.per_gaussian  # the mean number that leaves time for so many
        final = min(final, max(initial, (wanted - growing * initial) / (1.0 - growing)))
    return max(1, int(seconds / max(1e-9, cost.at(mean(final))))), math.ceil(final)
