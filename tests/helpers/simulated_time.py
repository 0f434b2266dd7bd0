"""Clocks that a test moves, in the place of the machine's."""

from __future__ import annotations

import time

import pytest
from torch.utils._python_dispatch import TorchDispatchMode


class SimulatedTime:
    """`time.perf_counter`, which stands still until it is told that time passes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def passes(self, seconds: float) -> None:
        self.now += seconds


class OperatorTime(TorchDispatchMode):
    """`time.perf_counter`, which goes on by a second with every operator of torch while this is entered."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now = 0.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        self.now += 1.0
        return operator(*args, **(kwargs or {}))
