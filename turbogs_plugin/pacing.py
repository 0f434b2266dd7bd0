"""How far a run goes, and where it stops on the way: by iterations, or by time. And what budgets change before it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from turbogs_plugin.budget import IterationCost, MemoryDemand, TimePlan, fit_to_time, with_cap
from turbogs_plugin.config import Config, TrainConfig, resolve
from turbogs_plugin.errors import InputError
from turbogs_plugin.evaluation import free_device_memory, synchronize
from turbogs_plugin.lengths import with_iterations
from turbogs_plugin.scene import Scene
from turbogs_plugin.trainer import Trainer

CALIBRATION_SHARE = 0.04
"""Of the time budget, for the measurement that the first plan rests on."""
WARMUP_ITERATIONS = {"cuda": 20, "cpu": 1}
"""Not measured: they load code and find the sizes of buffers."""
FEWEST_MEASURED = {"cuda": 20, "cpu": 2}
LARGEST_OVERHEAD = 0.7
"""Share of a time budget that may go before the first iteration."""


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
        self._evaluations = train.evaluation_iterations()
        self._saves = set(range(0, self.iterations, train.checkpoint_every or self.iterations)[1:]) | {self.iterations}

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        pass

    def next_mark(self, iteration: int, seconds: float) -> int:
        return min(mark for mark in self._evaluations | self._saves if mark > iteration)

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        return Due(iteration in self._evaluations, iteration in self._saves)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class TimePace:
    """As many iterations as fit into a time; `train.iterations` and `train.refine_until` follow the plan.

    Evaluations are at the configured fractions of the time.

    Args:
        train: of the run, whose lengths are changed as the run goes.
        seconds: of training, what came before the first iteration included.
        cost: of an iteration, from the calibration; without one, growth is not foreseen.
        cap: never more Gaussians than that; 0: none.
    """

    def __init__(self, train: TrainConfig, seconds: float, cost: IterationCost | None, cap: int) -> None:
        self._train = train
        self._fractions = sorted({*train.evaluate_at, 1.0})
        self._plan = TimePlan(seconds, train.iterations, train.refine_until, cost or IterationCost(1.0, 0.0), cap)
        self._evaluated = 0
        self._saved = 0

    @property
    def iterations(self) -> int:
        return self._train.iterations

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        self._plan.start(iteration, seconds, gaussians)

    def next_mark(self, iteration: int, seconds: float) -> int:
        return self._plan.next_mark(iteration, seconds)

    def reached(self, iteration: int, seconds: float, gaussians: int) -> Due:
        self._plan.replan(iteration, seconds, gaussians)
        self._follow()
        finished, every = iteration >= self.iterations, self._train.checkpoint_every
        passed = sum(fraction <= seconds / self._plan.seconds for fraction in self._fractions)
        save = finished or bool(every and iteration // every > self._saved // every)
        due = Due(finished or passed > self._evaluated, save)
        self._evaluated = max(passed, self._evaluated)
        self._saved = iteration if save else self._saved
        return due

    def state_dict(self) -> dict[str, Any]:
        plan = self._plan
        return {
            "iterations": plan.iterations,
            "refine_until": plan.refine_until,
            "evaluated": self._evaluated,
            "saved": self._saved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._plan.iterations, self._plan.refine_until = state["iterations"], state["refine_until"]
        self._evaluated, self._saved = state["evaluated"], state["saved"]
        self._follow()

    def _follow(self) -> None:
        self._train.iterations, self._train.refine_until = self._plan.iterations, self._plan.refine_until


def pace_of(config: Config, cost: IterationCost | None = None) -> Pace:
    """The pace of a run."""
    seconds = config.budget.seconds()
    if seconds is None:
        return IterationPace(config.train)
    return TimePace(config.train, seconds, cost, config.budget.max_gaussians)


@dataclass(frozen=True)
class Calibration:
    """What was measured of a scene on this machine before its training.

    Args:
        seconds: that the measurement took.
        initialisation: seconds of `Trainer.initialise_maps`, extrapolated from one view.
        cost: of an iteration.
        gaussians: at the start.
    """

    seconds: float
    initialisation: float
    cost: IterationCost
    gaussians: int


def within_budget(config: Config, scene: Scene, device: torch.device) -> tuple[Config, Calibration | None]:
    """The configuration that keeps its budgets, and what was measured for it where time is one of them.

    Args:
        config: its places of maps and photos are decided.

    Raises:
        InputError: nothing fits, naming what would.
    """
    if config.budget.max_gaussians:
        config = with_cap(config, config.budget.max_gaussians)
    limit, seconds = config.budget.memory_bytes(), config.budget.seconds()
    if limit is not None:
        config = with_cap(config, _limited(config, scene, device, limit))
    if seconds is None:
        return config, None
    measured = calibrate(config, scene, device, CALIBRATION_SHARE * seconds)
    before = measured.seconds + measured.initialisation
    if before > LARGEST_OVERHEAD * seconds:
        raise InputError(
            f"--time-budget {config.budget.time} is too short here: {before:.1f} s pass before the first iteration; "
            f"allow {before / LARGEST_OVERHEAD:.0f}s or more"
        )
    train, present = config.train, config.budget.max_gaussians
    share = min(1.0, train.refine_until / train.iterations)
    iterations, cap = fit_to_time(seconds - before, measured.cost, measured.gaussians, present, train.iterations, share)
    if cap != present:
        config = with_cap(config, cap)
    return with_iterations(config, iterations), measured


def budget_text(config: Config, measured: Calibration | None) -> str:
    """What the budgets came to, for a terminal; empty where there are none.

    Args:
        config: as `within_budget` gave it.
    """
    parts = []
    if config.budget.max_gaussians:
        parts.append(f"at most {config.budget.max_gaussians} Gaussians")
    if config.budget.max_memory:
        parts.append(f"{config.budget.max_memory} of device memory")
    if measured is not None:
        cost = 1e3 * measured.cost.at(measured.gaussians)
        parts.append(
            f"{config.budget.time} of training: about {config.train.iterations} iterations, for one "
            f"takes {cost:.3g} ms with {measured.gaussians} Gaussians (measured in {measured.seconds:.1f} s)"
        )
    return f"budget: {'; '.join(parts)}" if parts else ""


def _limited(config: Config, scene: Scene, device: torch.device, limit: int) -> int:
    """Hold torch to a limit of device memory; how many Gaussians fit into it."""
    if device.type != "cuda":
        raise InputError("--max-memory limits the memory of a GPU: leave it out with --device cpu")
    train, test = scene.train.cameras.sizes.prod(axis=1), scene.test.cameras.sizes.prod(axis=1)
    largest = int(max(train.max(), test.max()))
    count = MemoryDemand.of(config, int(train.sum()), int(test.sum()), largest, len(train)).gaussians(limit)
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total))
    return count


@torch.no_grad()
def calibrate(config: Config, scene: Scene, device: torch.device, seconds: float) -> Calibration:
    """Measure what an iteration costs with the initial model and with half of it, all bands in use.

    Args:
        seconds: to measure for; more where the fewest iterations take longer.
    """
    started = time.perf_counter()
    still = resolve({**config.to_mapping(), "density": {"type": "none"}})
    trainer = Trainer(still, scene, device)
    gaussians = len(trainer.gaussians)
    initialisation, cost = _measure(trainer, seconds)
    del trainer
    free_device_memory(device)
    return Calibration(time.perf_counter() - started, initialisation, cost, gaussians)


def _measure(trainer: Trainer, seconds: float) -> tuple[float, IterationCost]:
    """(seconds of `Trainer.initialise_maps`, cost of an iteration)."""
    model, device = trainer.gaussians, trainer.gaussians.device
    train = trainer.config.train
    trainer.initialise_map(0)  # loads code
    view = _seconds_of(lambda: trainer.initialise_map(0), 1, 0.0, device)
    measured = []
    for stride in (2, 1):
        trainer.gaussians = model.map(lambda value, stride=stride: value[::stride].clone())
        trainer.optimizer.setup(trainer.gaussians)
        trainer.iteration = train.sh_degree * train.sh_interval
        for _ in range(WARMUP_ITERATIONS[device.type]):
            trainer.step()
        cost = _seconds_of(trainer.step, FEWEST_MEASURED[device.type], 0.5 * seconds, device)
        measured.append((len(trainer.gaussians), cost))
    trainer.repeat_lost(wait=True)
    return view * len(trainer.views), IterationCost.through(*measured)


def _seconds_of(function: Callable[[], None], fewest: int, seconds: float, device: torch.device) -> float:
    """Of one call: the mean over as many as fit into `seconds`, at least `fewest`."""
    synchronize(device)
    started, calls = time.perf_counter(), 0
    while calls < fewest or time.perf_counter() - started < seconds:
        function()
        calls += 1
    synchronize(device)
    return (time.perf_counter() - started) / calls
