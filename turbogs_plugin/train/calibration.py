"""How budgets change the configuration before a run.

A memory budget lowers the cap on Gaussians. A time budget sets the number of iterations and of pixels per iteration,
from iterations timed on this machine.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, replace

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan import caps, pixels
from turbogs_plugin.plan.memory import MemoryDemand
from turbogs_plugin.plan.time import IterationCost, fit_to_time
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.clock import TrainingClock
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.start import require_gpu_memory
from turbogs_plugin.train.trainer import Trainer

CALIBRATION_SHARE = 0.04
"""Share of the time budget for the measurements behind the first plan; half of it for lambda as configured."""
CALIBRATION_SECONDS = 5.0
"""The measurements never take longer, as more of them would add nothing."""
WARMUP_ITERATIONS = {"cuda": 20, "cpu": 1}
"""Iterations that are not measured: they load code and find the sizes of buffers."""
FEWEST_MEASURED = {"cuda": 20, "cpu": 2}
LARGEST_OVERHEAD = 0.7
"""Share of a time budget that may pass before the first iteration."""
MEMORY_SHARE = 0.5
"""Share of a GPU's free memory that a run without a limit may take if it has more pixels than configured."""


@dataclass(frozen=True)
class Calibration:
    """What was measured of a scene on this machine before its training.

    Args:
        seconds: duration of the measurement.
        initialisation: seconds of `Trainer.initialise_maps`, extrapolated from one view.
        cost: cost of an iteration with `pixel_budget`.
        gaussians: number at the start.
        configured_pixel_budget, pixel_budget: lambda as configured, and as chosen to fill the time.
    """

    seconds: float
    initialisation: float
    cost: IterationCost
    gaussians: int
    configured_pixel_budget: float
    pixel_budget: float


def within_budget(
    config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE
) -> tuple[Config, Calibration | None]:
    """The configuration that keeps its budgets, and what was measured for a time budget, if there is one.

    Args:
        config: the places of maps and photos are decided in it.
        ranks: the processes that will train; all call this together, and the first one's clock counts.

    Raises:
        InputError: nothing fits; the message names what would.
    """
    limit, seconds = config.budget.memory_bytes(), config.budget.seconds()
    if limit is not None:
        hold_to(limit, device)
        config = _within_memory(config, scene, limit)
    if seconds is None:
        return config, None
    measured = calibrate(config, scene, device, seconds, ranks)
    if measured.pixel_budget > measured.configured_pixel_budget:
        config = pixels.with_pixel_budget(config, measured.pixel_budget)
        if limit is not None:
            config = _within_memory(config, scene, limit)
    left = seconds - (measured.seconds + measured.initialisation)
    iterations, cap = _fit(config, left, measured.cost, measured.gaussians)
    if cap != caps.growth_cap(config, measured.gaussians):
        config = caps.lowered_cap(config, cap)
    return with_iterations(config, iterations), measured


def budget_text(config: Config, measured: Calibration | None) -> str:
    """The results of the budgets, for a terminal; empty if there are none.

    Args:
        config: from `within_budget`.
    """
    parts = []
    if caps.cap_of(config):
        parts.append(f"at most {caps.cap_of(config)} Gaussians at the end")
    if config.budget.max_memory:
        parts.append(f"{config.budget.max_memory} of device memory")
    if measured is not None:
        # Three digits, and never as 1.02e+03.
        cost = float(f"{1e3 * measured.cost.at(measured.gaussians):.3g}")
        configured, chosen = measured.configured_pixel_budget, measured.pixel_budget
        raised = f" with schedule.pixel_budget {chosen:g} instead of {configured:g}" if chosen > configured else ""
        parts.append(
            f"{config.budget.time} of training: about {config.train.iterations} iterations{raised}, for one "
            f"takes {cost:.10g} ms with {measured.gaussians} Gaussians (measured in {measured.seconds:.1f} s)"
        )
    return f"budget: {'; '.join(parts)}" if parts else ""


def hold_to(limit: int, device: torch.device) -> None:
    """Hold torch to a limit of device memory, for the rest of the process.

    Raises:
        InputError: the device is no GPU.
    """
    require_gpu_memory(device)
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total))


def _within_memory(config: Config, scene: Scene, limit: int) -> Config:
    """The configuration whose largest number of Gaussians fits into the memory."""
    most = _memory_demand(config, scene).gaussians(limit)
    return caps.lowered_cap(config, max(1, int(most / caps.growth_room(config))))


def _memory_demand(config: Config, scene: Scene) -> MemoryDemand:
    sizes = (scene.train.cameras.sizes, scene.test.cameras.sizes)
    return MemoryDemand.of(config, *sizes, photo_bytes=scene.train.photos.stored.shape[1])


def _fit(config: Config, seconds: float, cost: IterationCost, gaussians: int) -> tuple[int, int]:
    """`fit_to_time` of a configuration: (iterations, cap)."""
    train = config.train
    share = min(1.0, train.refine_until / train.iterations)
    cap = caps.growth_cap(config, gaussians)
    return fit_to_time(seconds, cost, gaussians, cap, train.iterations, share, caps.keeps_cap(config))


def calibrate(config: Config, scene: Scene, device: torch.device, seconds: float, ranks: Ranks) -> Calibration:
    """Measure the cost of an iteration. If more than the configured iterations fit, measure it with more pixels too.

    Args:
        seconds: the time budget. `CALIBRATION_SHARE` of it is used here, at most `CALIBRATION_SECONDS`; more if the
            fewest iterations to measure take longer.
        ranks: as in `within_budget`.

    Raises:
        InputError: too much of the time would pass before the first iteration.
    """
    started = time.perf_counter()
    measured = _measure(config, scene, device, seconds, started, ranks)
    free_device_memory(device)
    return replace(measured, seconds=ranks.agree(time.perf_counter() - started))


@torch.no_grad()
def _measure(
    config: Config, scene: Scene, device: torch.device, seconds: float, started: float, ranks: Ranks
) -> Calibration:
    """`calibrate` without the clean-up."""
    trial = _Trial(config, scene, device, ranks)
    gaussians, share = trial.gaussians, 0.5 * min(CALIBRATION_SHARE * seconds, CALIBRATION_SECONDS)
    initialisation, cost = trial.initialisation(), trial.cost(share)
    before = ranks.agree(time.perf_counter() - started + initialisation)
    if before > LARGEST_OVERHEAD * seconds:
        raise InputError(
            f"--time-budget {config.budget.time} is too short here: {before:.1f} s pass before the first iteration; "
            f"allow {math.ceil(before / LARGEST_OVERHEAD)}s or more"
        )
    configured, largest = pixels.pixel_budget_range(config, len(scene.train))
    largest = min(largest, configured + ranks.agree(_room_for_images(config, scene, device, gaussians)))
    # More epochs than configured would overfit the photos.
    images = pixels.images_per_iteration(config, len(scene.train))
    wanted = max(config.train.iterations, math.ceil(config.train.epochs * len(scene.train) / images))
    # A measured iteration with more pixels takes at most about seconds / iterations.
    fewest = WARMUP_ITERATIONS[device.type] + FEWEST_MEASURED[device.type]
    raises = min(pixels.RAISES, max(1, int(CALIBRATION_SHARE * wanted / fewest)))
    costs = {configured: cost}

    def fitting(pixel_budget: float) -> int:
        if pixel_budget not in costs:
            # Measured with one size of model: with two, the noise of their slope would decide.
            factor = trial.seconds_with(pixel_budget, share / pixels.RAISES) / cost.at(gaussians)
            costs[pixel_budget] = IterationCost(factor * cost.base, factor * cost.per_gaussian)
        left = ranks.agree(seconds - initialisation - (time.perf_counter() - started))
        return _fit(config, left, costs[pixel_budget], gaussians)[0]

    chosen = pixels.pixels_for_time(configured, largest, wanted, raises, fitting)
    taken = ranks.agree(time.perf_counter() - started)
    return Calibration(taken, initialisation, costs[chosen], gaussians, configured, chosen)


def _room_for_images(config: Config, scene: Scene, device: torch.device, gaussians: int) -> float:
    """How much lambda may rise before it takes memory from the Gaussians that are expected."""
    limit = config.budget.memory_bytes()
    if limit is None and device.type != "cuda":
        return math.inf
    if limit is None:
        limit = int(MEMORY_SHARE * (torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)))
    expected = max(caps.FEWEST_GAUSSIANS, caps.expected_gaussians(gaussians, caps.growth_cap(config, gaussians)))
    return _memory_demand(config, scene).more_images(limit, caps.growth_room(config) * expected)


class _Trial:
    """Iterations made before training to time them, with a model that does not grow and all bands in use."""

    def __init__(self, config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE) -> None:
        self._config, self._ranks = caps.without_growth(config), ranks
        self._trainer = Trainer(self._config, scene, device, engine=ranks.engine(device))
        self._model = self._trainer.gaussians.map(torch.clone)  # the trainer may place the next one over it
        self._device = device
        self.gaussians = len(self._model)

    def initialisation(self) -> float:
        """Seconds of `Trainer.initialise_maps`, from one view."""
        trainer = self._trainer
        trainer.maps.initialise(0, trainer.dense_errors(0))  # loads code
        with TrainingClock(self._device) as clock:
            trainer.maps.initialise(0, trainer.dense_errors(0))
        return self._ranks.agree(clock.seconds) * math.ceil(len(trainer.views) / self._ranks.count)

    def cost(self, seconds: float) -> IterationCost:
        """Cost of an iteration as configured: the line through the times of half the model and of all of it."""
        half, whole = (self._timed(stride, 0.5 * seconds) for stride in (2, 1))
        return IterationCost.through(half, whole)

    def seconds_with(self, pixel_budget: float, seconds: float) -> float:
        """Seconds of an iteration with this lambda and the whole model."""
        self._trainer.schedule = pixels.with_pixel_budget(self._config, pixel_budget).build("schedule")
        return self._timed(1, seconds)[1]

    def _timed(self, stride: int, seconds: float) -> tuple[int, float]:
        """(Gaussians, seconds of an iteration) with every `stride`-th of the initial model."""
        trainer, train = self._trainer, self._config.train
        trainer.begin_with(self._model.map(lambda value: value[::stride].clone()))
        # About half way, a schedule's views and rates are near their means.
        trainer.iteration = max(train.sh_degree * train.sh_interval, train.iterations // 2)
        TrainingLoop(trainer, ranks=self._ranks).advance(trainer.iteration + WARMUP_ITERATIONS[self._device.type])
        enough = _Enough(FEWEST_MEASURED[self._device.type], seconds)
        loop = TrainingLoop(trainer, listeners=[enough], ranks=self._ranks)
        loop.advance(sys.maxsize)
        return len(trainer.gaussians), loop.clock.seconds / enough.iterations


@dataclass
class _Enough(Listener):
    """Stops after at least `fewest` iterations and `seconds` seconds."""

    fewest: int
    seconds: float
    iterations: int = 0

    def advanced(self, loop: TrainingLoop) -> None:
        self.iterations += 1
        several = loop.ranks.count > 1  # they ask each other, which waits, so not after every iteration
        if self.iterations >= self.fewest and not (several and self.iterations % self.fewest):
            loop.stopped = loop.stopped or loop.ranks.agree(loop.clock.now() >= self.seconds)
