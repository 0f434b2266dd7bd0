"""The one loop: what it tells whom and when, iterations lost at a mark or a stop, and what its imports load."""

from types import SimpleNamespace

import pytest
import torch
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.train.loop import Listener, TrainingLoop


class CountingTrainer:
    """Iterations that do nothing. `lost`: numbers of those that are found lost as soon as the GPU is waited for."""

    device = torch.device("cpu")

    def __init__(self, iterations: int, lost: tuple[int, ...] = (), **settings) -> None:
        train = TrainConfig(iterations=iterations, refine_until=iterations, **settings)
        self.config, self.steps = SimpleNamespace(train=train), []
        self.initialised = self.concluded = False
        self._lost, self.iteration, self._unnoticed = set(lost), 0, 0

    def initialise_maps(self) -> None:
        self.initialised = True

    def step(self) -> None:
        self.iteration += 1
        self.steps.append(self.iteration)
        if self._unnoticed or self.iteration in self._lost:
            self._lost.discard(self.iteration)
            self._unnoticed += 1

    def repeat_lost(self, wait: bool = False) -> None:
        assert wait
        self.iteration -= self._unnoticed
        self._unnoticed = 0

    def complete(self) -> None:
        self.completed = self.iteration

    def set_length(self, iterations: int, refine_until: int) -> None:
        self.length = (iterations, refine_until)

    def conclude(self) -> None:
        assert self.iteration == self.length[0]
        self.concluded = True


class Diary(Listener):
    def __init__(self) -> None:
        self.lines: list[tuple[str, int]] = []

    def begun(self, loop: TrainingLoop) -> None:
        assert loop.trainer.initialised
        self.lines.append(("begun", loop.trainer.iteration))

    def evaluation_due(self, loop: TrainingLoop) -> None:
        assert loop.trainer.concluded == loop.finished and loop.trainer.completed == loop.trainer.iteration
        self.lines.append(("evaluation", loop.trainer.iteration))

    def checkpoint_due(self, loop: TrainingLoop) -> None:
        self.lines.append(("checkpoint", loop.trainer.iteration))


class StopAt5(Listener):
    def advanced(self, loop: TrainingLoop) -> None:
        if loop.trainer.iteration == 5:
            loop.stop()


def test_an_evaluation_comes_before_the_checkpoint_of_the_same_place():
    trainer, diary = CountingTrainer(6, evaluate_at=(0.5,), checkpoint_every=3), Diary()
    loop = TrainingLoop(trainer)
    loop.listeners = [diary]
    loop.run()
    assert diary.lines == [("begun", 0), *(("evaluation", 3), ("checkpoint", 3)), ("evaluation", 6), ("checkpoint", 6)]
    assert loop.finished and not loop.stopped and trainer.steps == [1, 2, 3, 4, 5, 6]
    assert trainer.concluded and trainer.length == (6, 6)


@pytest.mark.parametrize("lost", [(3,), (2,), (1,), (6,)])
def test_no_iteration_is_missing_at_a_mark(lost):
    """All from the lost one up to the mark are repeated before anything is said to be due there."""
    trainer, diary = CountingTrainer(6, lost, evaluate_at=(0.5,), checkpoint_every=0), Diary()
    loop = TrainingLoop(trainer)
    loop.listeners = [diary]
    loop.run()
    mark = 3 if lost[0] <= 3 else 6
    repeated = list(range(lost[0], mark + 1))
    assert trainer.steps == [*range(1, mark + 1), *repeated, *range(mark + 1, 7)]
    assert diary.lines == [("begun", 0), ("evaluation", 3), ("evaluation", 6), ("checkpoint", 6)]


def test_no_iteration_is_missing_at_a_stop():
    """Back at a place that was evaluated and saved before, it is not evaluated and saved again."""
    trainer, diary = CountingTrainer(9, lost=(4,), evaluate_at=(1 / 3,), checkpoint_every=3), Diary()
    loop = TrainingLoop(trainer)
    loop.listeners = [diary, StopAt5()]
    loop.run()
    assert loop.stopped and not loop.finished and trainer.iteration == 3 and not trainer.concluded
    assert diary.lines == [("begun", 0), ("evaluation", 3), ("checkpoint", 3)]


def test_only_training_is_on_the_clock(monkeypatch):
    """An hour of evaluations takes no time; an iteration takes a second, and so do the maps."""
    clock = SimulatedTime(monkeypatch)

    class Slow(Listener):
        def begun(self, loop: TrainingLoop) -> None:
            clock.passes(3600.0)

        evaluation_due = checkpoint_due = begun

    trainer = CountingTrainer(6, evaluate_at=(0.5,))
    step, initialise = trainer.step, trainer.initialise_maps
    trainer.step = lambda: (step(), clock.passes(1.0))
    trainer.initialise_maps = lambda: (initialise(), clock.passes(1.0))
    loop = TrainingLoop(trainer, seconds=2.0)
    loop.listeners = [Slow()]
    loop.run()
    assert loop.clock.seconds == 2.0 + 1.0 + 6.0
