"""How far a run goes, and where it stops on the way: by iterations, or by time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.plan.caps import cap_of
from turbogs_plugin.plan.time import IterationCost, TimePlan


@dataclass(frozen=True)
class Due:
    """What is to be done at a stop."""

    evaluate: bool
    save: bool


class Pace(Protocol):
    """Where a run stops to be evaluated and saved, and where it ends."""

    @property
    def iterations(self) -> int:
        """T, as known now."""
        ...

    @property
    def refine_until(self) -> int:
        """The last iteration of density control, as known now."""
        ...

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Training begins or goes on, with so many finished iterations and seconds of training."""
        ...

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration to stop at next."""
        ...

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        """Training has stopped here."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class IterationPace:
    """A fixed number of iterations."""

    def __init__(self, train: TrainConfig) -> None:
        self.iterations = train.iterations
        self.refine_until = train.refine_until
        self._evaluations = train.evaluation_iterations()
        self._save_every = train.checkpoint_every or self.iterations

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        pass

    def next_mark(self, iteration: int, seconds: float) -> int:
        save = iteration - iteration % self._save_every + self._save_every
        return min(save, self.iterations, *(mark for mark in self._evaluations if mark > iteration))

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        save = iteration == self.iterations or (iteration > 0 and iteration % self._save_every == 0)
        return Due(iteration in self._evaluations, save)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class TimePace:
    """As many iterations as fit into a time. Evaluations are at the configured fractions of the time.

    Args:
        train: of the run; its iterations and its end of density control are what is planned first.
        seconds: of training, what came before the first iteration included.
        cost: of an iteration, from the calibration; without one, growth is not foreseen.
        cap: never more Gaussians than that; 0: none.
    """

    def __init__(self, train: TrainConfig, seconds: float, cost: IterationCost | None, cap: int) -> None:
        self._save_every = train.checkpoint_every
        self._fractions = sorted({*train.evaluate_at, 1.0})
        self._plan = TimePlan(seconds, train.iterations, train.refine_until, cost or IterationCost(1.0, 0.0), cap)
        self._evaluated = 0
        self._saved = 0

    @property
    def iterations(self) -> int:
        return self._plan.iterations

    @property
    def refine_until(self) -> int:
        return self._plan.refine_until

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        self._plan.start(iteration, seconds, gaussians)

    def next_mark(self, iteration: int, seconds: float) -> int:
        return self._plan.next_mark(iteration, seconds)

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        self._plan.replan(iteration, seconds, gaussians)
        finished, every = iteration >= self.iterations, self._save_every
        passed = sum(fraction <= seconds / self._plan.seconds for fraction in self._fractions)
        save = finished or bool(every and iteration // every > self._saved // every)
        due = Due(finished or passed > self._evaluated, save)
        self._evaluated = max(passed, self._evaluated)
        self._saved = iteration if save else self._saved
        return due

    def state_dict(self) -> dict[str, Any]:
        return {**self._plan.state_dict(), "evaluated": self._evaluated, "saved": self._saved}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._plan.load_state_dict(state)
        self._evaluated, self._saved = state["evaluated"], state["saved"]


def pace_of(config: Config, cost: IterationCost | None = None) -> Pace:
    """The pace of a run."""
    seconds = config.budget.seconds()
    if seconds is None:
        return IterationPace(config.train)
    return TimePace(config.train, seconds, cost, cap_of(config))
