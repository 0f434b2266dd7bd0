"""Learning rates of the parameters over a run, shared by every optimizer."""

from __future__ import annotations

from dataclasses import dataclass

from turbogs_plugin.engine.rules import ParameterRates
from turbogs_plugin.errors import require
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.types import PARAMETER_NAMES, Step

LENGTH_POWER = 0.5
"""How fast first rates fall with the length of a run. Measured on five captures of 2,300 to 13,800 iterations."""
MOST_GAIN = 1.75
"""Largest factor that a short run gives to the first rates."""


@dataclass
class LearningRates:
    """The rates of 3DGS, with the decay of the means over the run and one factor for batches of views.

    With rate r, Adam moves a parameter by about r in an iteration whose gradients agree with the past ones, whatever
    their size. The mean over K views has less noise than one view's gradient but no longer step. A run of few
    iterations of many views therefore needs higher rates than 3DGS, which has one view.

    Args:
        means: rate of the means at the first iteration, in units of the scene extent.
        means_final: rate of the means at the last iteration; between the two the rate decays exponentially.
        scales: rate of the log standard deviations.
        quats: rate of the quaternions.
        opacities: rate of the opacity logits.
        sh0: rate of band 0.
        shN: rate of the higher bands.
        final_factor: share of themselves to which all rates but the means' fall exponentially over the run.
        batch_scale: factor of every rate at every iteration, whatever K is at that iteration. 2 gained 0.5 dB over 1
            (fox, 4000 iterations, K from 10 down to 3); one-view baselines (3DGS) set 1.
        written_for: length of a run, in iterations, for which the rates are written. In a run of T iterations, the
            first rates of all parameters but the means are ``(written_for / T) ** LENGTH_POWER`` times as large: a
            longer run begins more gently. Last rates stay. 0: rates know no length.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20
    final_factor: float = 1.0
    batch_scale: float = 2.0
    written_for: int = 0

    def __post_init__(self) -> None:
        require_settings(self)
        allowed = f"above 0 as means ({self.means}) is, for the decay is exponential; or both 0 to hold the means"
        require((self.means > 0) == (self.means_final > 0), "means_final", self.means_final, allowed)

    def at(self, step: Step) -> ParameterRates:
        """The rates at an iteration. Rates of the means are in world units (times `step.scene_extent`)."""
        fraction = min(1.0, step.iteration / max(1, step.total))
        means = self.means and self.means * (self.means_final / self.means) ** fraction
        factor = self.batch_scale * self.final_factor**fraction * self._gain(step.total) ** (1.0 - fraction)
        rest = {name: factor * getattr(self, name) for name in PARAMETER_NAMES if name != "means"}
        return ParameterRates(means=self.batch_scale * means * step.scene_extent, **rest)

    def _gain(self, iterations: int) -> float:
        """Factor of the first rates in a run of this length."""
        if not self.written_for:
            return 1.0
        return min(MOST_GAIN, (self.written_for / max(1, iterations)) ** LENGTH_POWER)
