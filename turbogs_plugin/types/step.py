"""The present iteration of a run, and how much it samples."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Step:
    """The present iteration of a run. Algorithm 1's rho is `progress`; the scheduling appendix's rho is `anneal`.

    Args:
        iteration: t, from 0.
        total: T, iterations of the whole run.
        refine_until: tau_until, the last iteration of densification.
        seed: of the run; all randomness is a function of (seed, iteration, place).
        scene_extent: 1.1 times the largest distance of a camera from their mean, in world units (`Scene.extent`).
    """

    iteration: int
    total: int
    refine_until: int
    seed: int = 0
    scene_extent: float = 1.0

    @property
    def progress(self) -> float:
        """clip(t / tau_until, 0, 1): 0 at the start, 1 once densification is over."""
        return min(1.0, self.iteration / max(1, self.refine_until))

    @property
    def anneal(self) -> float:
        """1 - progress."""
        return 1.0 - self.progress


@dataclass(frozen=True)
class SamplingBudget:
    """Samples of one iteration: `views` (K) views, and the fraction `rate` (r) of each tile's pixels."""

    views: int
    rate: float
