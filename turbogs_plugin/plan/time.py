"""How many iterations fit into a time.

The cost of an iteration is ``base + per_gaussian * N``. Where fewer iterations fit than are configured, the run is that
much shorter; where these would be fewer than `FEWEST_SHARE` of the configured ones, Gaussians are given up for them.
Where more fit than are configured, and than `train.epochs` take, an iteration gets more pixels
(`turbogs_plugin.plan.pixels`) until these fill the time, and only then there are more iterations: those overfit the
photos (docs/budgets.md). While it trains, the number of iterations left follows the cost measured (`TimePlan`), so that
all that goes by progress (learning rates, sampling, density control) ends with the time.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from turbogs_plugin.plan.caps import expected_gaussians

FEWEST_SHARE = 0.3
"""Of the configured iterations; a shorter schedule gets fewer Gaussians instead."""
MARK_SHARE = 0.03
"""Of the time, between two looks at the clock; towards the end, half of what is left."""


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

    def times(self, factor: float) -> IterationCost:
        return IterationCost(factor * self.base, factor * self.per_gaussian)


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
        cap: never more Gaussians; 0: none.
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


@dataclass
class TimePlan:
    """The length of a run that is to end after a time, again and again fitted to what iterations cost.

    Args:
        seconds: when to end, on the clock of training.
        iterations, refine_until: of the schedule as planned so far.
        cost: how it depends on the number of Gaussians; only ratios of it count.
        cap: never more Gaussians; 0: none.
    """

    seconds: float
    iterations: int
    refine_until: int
    cost: IterationCost = field(default_factory=lambda: IterationCost(1.0, 0.0))
    cap: int = 0

    def __post_init__(self) -> None:
        self._refine_share = min(1.0, self.refine_until / self.iterations)
        self._last: tuple[int, float, int] | None = None
        self._now = 0.0  # seconds of an iteration, of late

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Where training stands as it begins or goes on."""
        self._last = (iteration, seconds, gaussians)
        if self._now == 0.0:
            self._now = max(0.0, self.seconds - seconds) / max(1, self.iterations - iteration)

    def replan(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Fit `iterations` and `refine_until` to where training stands.

        Density control that is over stays over.
        """
        before, started, fewer = self._last
        if iteration > before:
            latest = (seconds - started) / (iteration - before)
            self._now = latest if before == 0 else 0.5 * (self._now + latest)
            growth = (gaussians - fewer) / (iteration - before)
            self._last = (iteration, seconds, gaussians)
            left = max(0.0, self.seconds - seconds)
            cost = max(1e-9, self._now * self._rise(iteration, gaussians, growth))
            self.iterations = iteration + int(left / cost + 0.5)  # to the nearest, so half of one late or early
            if iteration < self.refine_until:
                self.refine_until = max(iteration, round(self._refine_share * self.iterations))

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration after which to look at the clock again."""
        stretch = min(MARK_SHARE * self.seconds, 0.5 * max(0.0, self.seconds - seconds))
        return min(self.iterations, iteration + max(1, int(stretch / max(1e-9, self._now))))

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "refine_until": self.refine_until,
            "cost": asdict(self.cost),
            "iteration_seconds": self._now,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.iterations, self.refine_until = state["iterations"], state["refine_until"]
        self.cost = IterationCost(**state["cost"])
        self._now = state["iteration_seconds"]

    def _rise(self, iteration: int, gaussians: int, growth: float) -> float:
        """Mean cost of the iterations left, in units of the present cost, if the number goes on to grow as of late."""
        left, growing = self.iterations - iteration, self.refine_until - iteration
        if growing <= 0 or left <= 0:
            return 1.0
        final = gaussians + max(0.0, growth) * growing
        final = max(gaussians, min(final, self.cap)) if self.cap else final
        mean = final - 0.5 * (final - gaussians) * growing / left
        return max(1.0, self.cost.at(mean) / max(1e-12, self.cost.at(gaussians)))
