"""The clock of training: what counts as time, in a run as in an ablation."""

from __future__ import annotations

import time

import torch

from turbogs_plugin.device import synchronize


class TrainingClock:
    """Seconds of training. Entered for training alone; waits for the GPU at both ends.

    Args:
        seconds: of training that passed before.
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
        """Seconds so far, while entered. Does not wait for the GPU, which the trainer never leaves far behind."""
        return self.seconds + time.perf_counter() - self._started
