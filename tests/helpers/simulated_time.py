"""Clocks that a test moves, in the place of the machine's."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from turbogs_plugin.train.trainer import Trainer


class SimulatedTime:
    """`time.perf_counter`, which stands still until it is told that time passes, but for `tick` seconds a look."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tick: float = 0.0) -> None:
        self.now, self.tick = 1000.0, tick
        monkeypatch.setattr(time, "perf_counter", self.read)

    def read(self) -> float:
        self.now += self.tick
        return self.now

    def passes(self, seconds: float) -> None:
        self.now += seconds

    def in_iterations(self, monkeypatch: pytest.MonkeyPatch, cost: Callable[[Trainer], float]) -> None:
        """So many seconds pass in every iteration of a trainer; a hundredth of one in the first look at a view."""
        step, look = Trainer.step, Trainer.dense_errors

        def stepping(trainer: Trainer) -> None:
            step(trainer)
            self.passes(cost(trainer))

        def looking(trainer: Trainer, view: int) -> Tensor:
            errors = look(trainer, view)
            self.passes(0.01)
            return errors

        monkeypatch.setattr(Trainer, "step", stepping)
        monkeypatch.setattr(Trainer, "dense_errors", looking)


class OperatorTime(TorchDispatchMode):
    """`time.perf_counter`, which goes on by a second with every operator of torch while this is entered."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now = 0.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        self.now += 1.0
        return operator(*args, **(kwargs or {}))
