"""Schedules of the views of an iteration and the share of their pixels (paper, appendix, adaptive scheduling).

All schedules but the fixed one share the appendix's two equations and differ in the modulation phi of the error
ratio::

    ratio = clip(E_mean / (E_init + eps), 0, 1)
    x     = 1 - anneal * phi(ratio)
    K     = round(K_min + (K_max - K_min) * exp(-alpha * x))
    r     = r_min + (r_max - r_min) * x,    r_min = lambda / K_max,  r_max = lambda / K_min

K * r stays at about lambda (`pixel_budget`): at first many views with few pixels each, then fewer views with more
pixels. In a scene with fewer views than K_min or K_max these two are lowered, so K * r stays at lambda there too.
r never exceeds 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from turbogs_plugin.strategies.checks import require_at_least_one, require_each, require_positive, require_settings
from turbogs_plugin.types import SamplingBudget, Step

EPSILON = 1e-12
"""Added to the initial error, which is zero where the initial model is already exact."""

STEEPNESS = 3.0
"""Steepness of the exponential modulation, which the paper does not give."""


@dataclass
class SinusoidalSchedule:
    """The appendix's equations, with its phi(ratio) = sin(pi/2 * sqrt(ratio)), most sensitive where the error is low.

    Args:
        min_views: K_min, fewest views of an iteration; 3 in the paper.
        max_views: K_max, most views of an iteration; 10 in the paper.
        pixel_budget: lambda, the pixels of one iteration in full images; (0, 1] in the paper.
        alpha: rate at which K falls from K_max to K_min; 3 in the paper.
    """

    min_views: int = 3
    max_views: int = 10
    pixel_budget: float = 1.0
    alpha: float = 3.0

    def __post_init__(self) -> None:
        require_at_least_one(self, "min_views")
        require_each(self, lambda value: value >= self.min_views, f"min_views ({self.min_views}) or more", "max_views")
        require_positive(self, "pixel_budget")
        require_settings(self)

    def phi(self, ratio: float) -> float:
        """The modulation of the error ratio, from [0, 1] onto [0, 1]."""
        return math.sin(0.5 * math.pi * math.sqrt(ratio))

    def query(self, step: Step, mean_error: float, initial_error: float, num_views: int) -> SamplingBudget:
        """The budget of this iteration.

        Args:
            step: gives `anneal`.
            mean_error, initial_error: mean over the training views of their mean error, now and at the start.
            num_views: V, an upper bound of K.
        """
        low, high = min(self.min_views, num_views), min(self.max_views, num_views)
        ratio = min(1.0, max(0.0, mean_error / (initial_error + EPSILON)))  # 0 where the quotient is not a number
        x = 1.0 - step.anneal * self.phi(ratio)
        views = math.floor(low + (high - low) * math.exp(-self.alpha * x) + 0.5)
        rate_low, rate_high = self.pixel_budget / high, self.pixel_budget / low
        return SamplingBudget(views, min(1.0, rate_low + (rate_high - rate_low) * x))


@dataclass
class LinearSchedule(SinusoidalSchedule):
    """phi(ratio) = ratio."""

    def phi(self, ratio: float) -> float:
        return ratio


@dataclass
class ExponentialSchedule(SinusoidalSchedule):
    """phi(ratio) = (1 - exp(-3 ratio)) / (1 - exp(-3)).

    The paper names an exponential variant but gives no equation. The one here saturates and passes (0, 0) and (1, 1).
    """

    def phi(self, ratio: float) -> float:
        return math.expm1(-STEEPNESS * ratio) / math.expm1(-STEEPNESS)


@dataclass
class FixedSchedule:
    """A fixed K at every iteration, and r = lambda / K.

    Args:
        views: K, views of an iteration.
        pixel_budget: lambda, the pixels of one iteration in full images.
    """

    views: int = 3
    pixel_budget: float = 1.0

    def __post_init__(self) -> None:
        require_at_least_one(self, "views")
        require_positive(self, "pixel_budget")
        require_settings(self)

    def query(self, step: Step, mean_error: float, initial_error: float, num_views: int) -> SamplingBudget:
        """As of `SinusoidalSchedule.query`; the errors change nothing."""
        views = min(self.views, num_views)
        return SamplingBudget(views, min(1.0, self.pixel_budget / views))
