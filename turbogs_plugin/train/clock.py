"""The clock that training is measured by, in a run as in an ablation."""

from __future__ import annotations

import time
from types import TracebackType

import torch


def synchronize(device: torch.device) -> None:
    """Wait for the GPU, so that a clock read next counts what was asked for; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class TrainingClock:
    """Seconds of training. Entered for training alone; waits for the GPU at both ends."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = 0.0

    def __enter__(self) -> TrainingClock:
        synchronize(self.device)
        self._started = time.perf_counter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        synchronize(self.device)
        self.seconds += time.perf_counter() - self._started

    def now(self) -> float:
        """Seconds so far, while entered. Does not wait for the GPU, which the trainer never leaves far behind."""
        return self.seconds + time.perf_counter() - self._started
