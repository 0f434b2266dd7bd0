"""The clock of a cell: the same for all, with warm-up, and with the GPU waited for at its marks."""

from __future__ import annotations

import time
from types import TracebackType

import torch

from turbogs_plugin.evaluation import synchronize

TIMING_RULES = (
    "Seconds are those of training alone: the initial error maps and the iterations, by one clock for all cells, with "
    "the GPU waited for wherever it is read. Loading, evaluation, and reports are not in them."
)


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


class PeakMemory:
    """Peak of the GPU's tensors while training, without what evaluations need; nothing on a CPU.

    One process trains all cells, so a CPU's peak, which is the process's, would be that of the largest cell so far.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.peak: int | None = None
        self.resume()

    def resume(self) -> None:
        """Begin to look again."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)

    def pause(self) -> None:
        """Take in the peak since `resume`."""
        if self.device.type == "cuda":
            self.peak = max(self.peak or 0, torch.cuda.max_memory_allocated(self.device))
