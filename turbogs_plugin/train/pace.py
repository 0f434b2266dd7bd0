"""The pace of a run: how far it goes, and where it stops on the way, by iterations or by time.

A time budget makes the run as long as ``seconds left / seconds of an iteration``: before it by a few iterations that
are timed and thrown away, then again and again while it trains.
"""

from __future__ import annotations

from typing import Any

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.plan.caps import without_growth
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.clock import TrainingClock
from turbogs_plugin.train.trainer import Trainer

MARK_SHARE = 0.03
"""Share of a time budget between two checks of the clock; at most half of the time left."""
TRIAL_ITERATIONS = {"cuda": 20, "cpu": 2}
"""Iterations that are timed before a run with a time budget. As many before them load code and size buffers."""


class IterationPace:
    """A fixed number of iterations.

    Attributes:
        iterations: T, as known now.
        refine_until: last iteration of density control, as known now.
    """

    def __init__(self, train: TrainConfig) -> None:
        self.iterations = int(train.iterations)
        self.refine_until = train.refine_until
        self._evaluations = train.evaluation_iterations()
        self._save_every = train.checkpoint_every or self.iterations

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration to stop at next."""
        save = iteration - iteration % self._save_every + self._save_every
        return min(save, self.iterations, *(mark for mark in self._evaluations if mark > iteration))

    def reached(self, iteration: int, seconds: float) -> tuple[bool, bool]:
        """Whether an evaluation is due where training has stopped, and whether a checkpoint is."""
        save = iteration == self.iterations or (iteration > 0 and iteration % self._save_every == 0)
        return iteration in self._evaluations, save

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class TimePace:
    """As many iterations as fit into a time.

    Everything that depends on progress (learning rates, sampling, density control) ends with the time. Evaluations are
    at the configured fractions of the time. Methods and attributes are those of `IterationPace`.

    Args:
        train: settings of the run. Its iterations and its end of density control are the first guess.
        seconds: when to end, on the clock of training; the time before the first iteration counts.
    """

    def __init__(self, train: TrainConfig, seconds: float) -> None:
        self.iterations = int(train.iterations)
        self.refine_until = train.refine_until
        self._seconds = seconds
        self._refine_share = min(1.0, self.refine_until / self.iterations)
        self._mean = 0.0  # seconds of a recent iteration; 0: none was timed
        self._last = (0, 0.0)  # iteration and seconds where the present stretch began
        self._fractions = sorted({*train.evaluate_at, 1.0})
        self._save_every = train.checkpoint_every
        self._evaluated = self._saved = 0

    def next_mark(self, iteration: int, seconds: float) -> int:
        self._last = (iteration, seconds)
        left = max(0.0, self._seconds - seconds)
        mean = self._mean or left / max(1, self.iterations - iteration)
        stretch = min(MARK_SHARE * self._seconds, 0.5 * left)
        return min(self.iterations, iteration + max(1, int(stretch / max(1e-9, mean))))

    def reached(self, iteration: int, seconds: float) -> tuple[bool, bool]:
        before, started = self._last
        if iteration > before:
            latest = (seconds - started) / (iteration - before)
            self._mean = 0.5 * (self._mean + latest) if self._mean else latest
            left = max(0.0, self._seconds - seconds)
            self.iterations = iteration + int(left / max(1e-9, self._mean) + 0.5)  # half an iteration early or late
            if iteration < self.refine_until:  # density control that has ended does not restart
                self.refine_until = max(iteration, round(self._refine_share * self.iterations))
        finished, every = iteration >= self.iterations, self._save_every
        passed = sum(fraction <= seconds / self._seconds for fraction in self._fractions)
        save = finished or bool(every and iteration // every > self._saved // every)
        evaluate = finished or passed > self._evaluated
        self._evaluated = max(passed, self._evaluated)
        self._saved = iteration if save else self._saved
        return evaluate, save

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "refine_until": self.refine_until,
            "iteration_seconds": self._mean,
            "evaluated": self._evaluated,
            "saved": self._saved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.iterations, self.refine_until = state["iterations"], state["refine_until"]
        self._mean, self._evaluated, self._saved = state["iteration_seconds"], state["evaluated"], state["saved"]


Pace = IterationPace | TimePace


def pace_of(config: Config) -> Pace:
    """The pace of a run."""
    seconds = config.budget.seconds()
    return IterationPace(config.train) if seconds is None else TimePace(config.train, seconds)


def fitted_to_time(config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE) -> tuple[Config, float]:
    """The configuration with as many iterations as its time budget leaves room for, and the seconds that went into
    timing some of them, which count as training.

    The iterations are timed with the initial model. Iterations of a model that grows take longer; `TimePace` corrects
    their number while it trains.

    Args:
        ranks: the processes that will train together; all call this, and the first one's clock counts.
    """
    budget = config.budget.seconds()
    if budget is None:
        return config, 0.0
    count, clock = TRIAL_ITERATIONS[device.type], TrainingClock(device)
    trial = Trainer(without_growth(config), scene, device, engine=ranks.engine(device))
    trial.iteration = int(config.train.iterations) // 2  # views, pixels and bands of an iteration are near their means
    for _ in range(2):  # the first time loads code and sizes buffers
        begun = clock.seconds
        with clock:
            for _ in range(count):
                trial.step()
        trial.repeat_lost(wait=True)
    del trial
    free_device_memory(device)
    spent, mean = ranks.agree((clock.seconds, (clock.seconds - begun) / count))
    return with_iterations(config, max(1, int((budget - spent) / max(1e-9, mean)))), spent
