"""The clock of training, which decides what counts as time in runs and ablations."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from turbogs_plugin.device import synchronize


class TrainingClock:
    """Seconds of training. Use it as a context around training alone; it waits for the GPU at both ends.

    Args:
        seconds: training time that passed before.
    """

    def __init__(self, device: torch.device, seconds: float = 0.0) -> None:
        self.device = device
        self.seconds = seconds

    def __enter__(self) -> TrainingClock:
        synchronize(self.device)
        self._started = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        synchronize(self.device)
        self.seconds += time.perf_counter() - self._started

    def now(self) -> float:
        """Seconds so far, within the context. Does not wait for the GPU, which is never far behind the trainer."""
        return self.seconds + time.perf_counter() - self._started

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Within the clock's own context: what is done inside is not training, and does not count."""
        synchronize(self.device)
        began = time.perf_counter()
        try:
            yield
        finally:
            self._started += time.perf_counter() - began
