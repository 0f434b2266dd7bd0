"""The clock of training, and the pace of a run: how far it goes and where it stops, by iterations or by time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.device import free_device_memory, synchronize
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.plan.memory import cap_of
from turbogs_plugin.plan.photo_gains import PhotoGains
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.trainer import Trainer

MARK_SHARE = 0.03
"""Share of a time budget between two checks of the clock; at most half of the time left."""
SAVE_AFTER, LOOK_AFTER = 200.0, 50.0
"""Seconds of training after which a checkpoint is due, and between two looks at the clock for that: where iterations
become twice as slow meanwhile, five minutes are at risk."""
TRIAL_ITERATIONS = {"cuda": 20, "cpu": 2}
"""Iterations that are timed before a run with a time budget. As many before them load code and size buffers."""


class TrainingClock:
    """Seconds of training, from those that passed before. Use it as a context around training alone; it waits for the
    GPU at both ends."""

    def __init__(self, device: torch.device, seconds: float = 0.0) -> None:
        self.device, self.seconds = device, seconds

    def __enter__(self) -> TrainingClock:
        synchronize(self.device)
        self._started = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        synchronize(self.device)
        self.seconds += time.perf_counter() - self._started

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Within the clock's own context: time spent inside is not training and does not count."""
        self.__exit__()
        try:
            yield
        finally:
            self.__enter__()


class Pace:
    """A fixed number of iterations, or as many as fit into a time: ``seconds left / seconds of an iteration`` at each
    look at the clock. With a time, T (`iterations`) and the end of density control (`refine_until`) follow it, and so
    does everything that depends on progress (learning rates, sampling, density control, evaluations).

    Args:
        train: settings of the run. With a time, its iterations and its end of density control are the first guess.
        budget: seconds when to end, on the clock of training; None: after the configured iterations.
    """

    def __init__(self, train: TrainConfig, budget: float | None = None) -> None:
        self.iterations, self.refine_until = train.written_iterations, int(train.refine_until)
        self._budget, self._fractions, self._save_every = budget, train.evaluate_at, train.checkpoint_every
        self._refine_share = min(1.0, self.refine_until / self.iterations)
        self._mean = (budget or 0.0) / self.iterations  # seconds of an iteration; 0: none was timed
        self._saved: float | None = None  # seconds at the last checkpoint
        self._last = (0, 0.0)  # iteration and seconds where the present stretch began
        self._evaluated = 0  # marks of evaluations that were passed

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration to stop at next."""
        self._last = (iteration, seconds)
        self._saved = seconds if self._saved is None else self._saved
        marks = [mark for mark in self._evaluations() if mark > iteration]
        stretches = []  # seconds until the next look at the clock
        if self._save_every:
            marks.append(iteration - iteration % self._save_every + self._save_every)
            stretches.append(LOOK_AFTER)
        if self._budget is not None:
            stretches.append(min(MARK_SHARE * self._budget, max(0.0, 0.5 * (self._budget - seconds))))
        marks += [iteration + max(1, int(stretch / self._mean if self._mean else 0)) for stretch in stretches]
        return min(self.iterations, *marks)

    def reached(self, iteration: int, seconds: float) -> tuple[bool, bool]:
        """Whether an evaluation is due where training has stopped, and whether a checkpoint is."""
        before, began = self._last
        if iteration > before:
            share = 1.0 if self._budget is None else (seconds - began) / (MARK_SHARE * self._budget)
            latest = max(1e-9, (seconds - began) / (iteration - before))
            self._mean += (min(0.5, share) if self._mean else 1.0) * (latest - self._mean)
            if self._budget is not None:
                left = max(0.0, self._budget - seconds)
                self.iterations = iteration + int(left / self._mean + 0.5)  # half an iteration off at most
                if iteration < self.refine_until:  # density control that has ended does not restart
                    self.refine_until = max(iteration, round(self._refine_share * self.iterations))
        finished, passed = iteration >= self.iterations, sum(mark <= iteration for mark in self._evaluations())
        evaluate, self._evaluated = finished or passed > self._evaluated, max(passed, self._evaluated)
        late = seconds - (self._saved or 0.0) >= SAVE_AFTER or iteration % (self._save_every or 1) == 0
        if save := finished or bool(self._save_every and late):
            self._saved = seconds
        return evaluate, save

    def _evaluations(self) -> set[int]:
        """Numbers of finished iterations after which to evaluate."""
        return {self.iterations, *(max(1, round(part * self.iterations)) for part in self._fractions)}

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "refine_until": self.refine_until,
            "iteration_seconds": self._mean,
            "evaluated": self._evaluated,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        length = state["iterations"], state["refine_until"]
        if self._budget is None and length != (self.iterations, self.refine_until):
            raise ValueError(f"its length is {length[0]}, and the configuration's {self.iterations}")
        self.iterations, self.refine_until = length
        self._mean, self._evaluated = state["iteration_seconds"], state["evaluated"]


def fitted_to_time(
    config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE, gains: PhotoGains | None = None
) -> tuple[Config, float]:
    """The configuration with as many iterations as its time budget leaves room for, and the seconds that went into
    timing some of them with the initial model, which count as training. `Pace` corrects their number as the model
    grows. All `ranks` that will train together call this, and the first one's clock counts."""
    budget = config.budget.seconds()
    if budget is None:
        return config, 0.0
    count, clock = TRIAL_ITERATIONS[device.type], TrainingClock(device)
    still = config.changed(density={"type": "none", "max_gaussians": cap_of(config)})  # the initial model all the time
    trial = Trainer(still, scene, device, ranks.engine(device), gains)
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
