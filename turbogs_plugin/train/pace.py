"""The pace of a run: how far it goes, and where it stops on the way, by iterations or by time."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.plan.caps import cap_of, growth_room
from turbogs_plugin.plan.time import IterationCost

MARK_SHARE = 0.03
"""Share of the time between two checks of the clock; but at most half of the time left."""


class Due(NamedTuple):
    """What is to be done at a stop."""

    evaluate: bool
    save: bool


class IterationPace:
    """A fixed number of iterations.

    Attributes:
        iterations: T, as known now.
        refine_until: the last iteration of density control, as known now.
    """

    def __init__(self, train: TrainConfig) -> None:
        self.iterations = int(train.iterations)
        self.refine_until = train.refine_until
        self._evaluations = train.evaluation_iterations()
        self._save_every = train.checkpoint_every or self.iterations

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Training begins or goes on, after this many finished iterations and seconds of training."""

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration to stop at next."""
        save = iteration - iteration % self._save_every + self._save_every
        return min(save, self.iterations, *(mark for mark in self._evaluations if mark > iteration))

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        """Training has stopped here."""
        save = iteration == self.iterations or (iteration > 0 and iteration % self._save_every == 0)
        return Due(iteration in self._evaluations, save)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class TimePace:
    """As many iterations as fit into a time. Their number is fitted again and again to what they cost.

    So everything that depends on progress (learning rates, sampling, density control) ends with the time. Evaluations
    are at the configured fractions of the time. Methods and attributes are those of `IterationPace`.

    Args:
        train: settings of the run. Its iterations and its end of density control are the first plan.
        seconds: when to end, on the clock of training; the time before the first iteration counts.
        cost: how the cost of an iteration depends on the number of Gaussians, from the calibration. Only its ratios
            count. None: growth is not foreseen.
        cap: most Gaussians at any time; 0: no cap.
    """

    def __init__(self, train: TrainConfig, seconds: float, cost: IterationCost | None = None, cap: int = 0) -> None:
        self.iterations = int(train.iterations)
        self.refine_until = train.refine_until
        self._seconds = seconds
        self._cost = cost or IterationCost(1.0, 0.0)
        self._cap = cap
        self._refine_share = min(1.0, self.refine_until / self.iterations)
        self._last: tuple[int, float, int] | None = None
        self._now = 0.0  # seconds of a recent iteration
        self._fractions = sorted({*train.evaluate_at, 1.0})
        self._save_every = train.checkpoint_every
        self._evaluated = 0
        self._saved = 0

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        self._last = (iteration, seconds, gaussians)
        if self._now == 0.0:
            self._now = max(0.0, self._seconds - seconds) / max(1, self.iterations - iteration)

    def next_mark(self, iteration: int, seconds: float) -> int:
        stretch = min(MARK_SHARE * self._seconds, 0.5 * max(0.0, self._seconds - seconds))
        return min(self.iterations, iteration + max(1, int(stretch / max(1e-9, self._now))))

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        self._replan(iteration, seconds, gaussians)
        finished, every = iteration >= self.iterations, self._save_every
        passed = sum(fraction <= seconds / self._seconds for fraction in self._fractions)
        save = finished or bool(every and iteration // every > self._saved // every)
        due = Due(finished or passed > self._evaluated, save)
        self._evaluated = max(passed, self._evaluated)
        self._saved = iteration if save else self._saved
        return due

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "refine_until": self.refine_until,
            "cost": asdict(self._cost),
            "iteration_seconds": self._now,
            "evaluated": self._evaluated,
            "saved": self._saved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.iterations, self.refine_until = state["iterations"], state["refine_until"]
        self._cost = IterationCost(**state["cost"])
        self._now = state["iteration_seconds"]
        self._evaluated, self._saved = state["evaluated"], state["saved"]

    def _replan(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Fit `iterations` and `refine_until` to the present state. Density control that has ended does not restart."""
        before, started, fewer = self._last
        if iteration > before:
            latest = (seconds - started) / (iteration - before)
            self._now = latest if before == 0 else 0.5 * (self._now + latest)
            growth = (gaussians - fewer) / (iteration - before)
            self._last = (iteration, seconds, gaussians)
            left = max(0.0, self._seconds - seconds)
            cost = max(1e-9, self._now * self._rise(iteration, gaussians, growth))
            self.iterations = iteration + int(left / cost + 0.5)  # the nearest: at most half an iteration early or late
            if iteration < self.refine_until:
                self.refine_until = max(iteration, round(self._refine_share * self.iterations))

    def _rise(self, iteration: int, gaussians: int, growth: float) -> float:
        """Mean cost of the iterations left over the present cost, if the number of Gaussians grows on as recently."""
        left, growing = self.iterations - iteration, self.refine_until - iteration
        if growing <= 0 or left <= 0:
            return 1.0
        final = gaussians + max(0.0, growth) * growing
        final = max(gaussians, min(final, self._cap)) if self._cap else final
        mean = final - 0.5 * (final - gaussians) * growing / left
        return max(1.0, self._cost.at(mean) / max(1e-12, self._cost.at(gaussians)))


Pace = IterationPace | TimePace
"""Either kind of pace."""


def pace_of(config: Config, cost: IterationCost | None = None) -> Pace:
    """The pace of a run."""
    seconds = config.budget.seconds()
    if seconds is None:
        return IterationPace(config.train)
    return TimePace(config.train, seconds, cost, int(growth_room(config) * cap_of(config)))
