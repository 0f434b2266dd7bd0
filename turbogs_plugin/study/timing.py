"""What the seconds of a cell are, and its peak of memory."""

from __future__ import annotations

import torch

from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop

TIMING_RULES = (
    "Seconds are those of training alone: the initial error maps and the iterations, by one clock for all cells, with "
    "the GPU waited for wherever it is read. Loading, evaluation, and reports are not in them."
)


class PeakMemory(Listener):
    """Peak of the GPU's tensors while training, without what evaluations need; nothing on a CPU.

    One process trains all cells, so a CPU's peak, which is the process's, would be that of the largest cell so far.

    Attributes:
        peak: bytes; None on a CPU.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.peak: int | None = None
        self._begin()

    def evaluating(self, loop: TrainingLoop) -> None:
        if self.device.type == "cuda":
            self.peak = max(self.peak or 0, torch.cuda.max_memory_allocated(self.device))

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self._begin()

    def _begin(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
