"""Progress on stderr: a bar on a terminal while a run trains, a line an evaluation elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop

if TYPE_CHECKING:
    from rich.progress import Progress

REFRESH_SECONDS = 0.1
"""Time between two updates of the bar, so that fast iterations are not slowed down."""


class TrainingProgress(Listener):
    """Shows iteration, time left, iterations a second, test PSNR and number of Gaussians.

    rich is imported for a terminal alone. A context: the bar is shown while it is entered.
    """

    def __init__(self) -> None:
        self._next_refresh = 0.0
        self._psnr = self._warning = ""
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            said = TextColumn("{task.description}")
            columns = (MofNCompleteColumn(), BarColumn(None), TimeRemainingColumn(), said)
            self._bar = Progress(*columns, console=Console(stderr=True), auto_refresh=False, expand=True)
            self._task = self._bar.add_task("", total=None)

    def __enter__(self) -> TrainingProgress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advanced(self, loop: TrainingLoop) -> None:
        if self._bar is None or time.perf_counter() < self._next_refresh:
            return
        self._next_refresh = time.perf_counter() + REFRESH_SECONDS
        trainer, speed = loop.trainer, self._bar.tasks[0].speed or 0.0
        said = f"{speed:,.0f} it/s  {self._psnr}{len(trainer.gaussians):,} Gaussians  {self._warning}"
        self._bar.update(self._task, completed=trainer.iteration, total=trainer.iterations, description=said)
        self._bar.refresh()

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        counts = {"non-finite losses": evaluation.nonfinite_losses, "skipped updates": evaluation.skipped_updates}
        self._psnr = f"PSNR {evaluation.psnr:.2f} dB  "
        self._warning = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        if self._bar is None:
            total = loop.trainer.iterations
            line = (
                f"iteration {evaluation.iteration:>{len(str(total))}}/{total}  {evaluation.train_seconds:7.1f} s  "
                f"test {self._psnr}SSIM {evaluation.ssim:.4f}  {evaluation.num_gaussians} Gaussians  {self._warning}"
            )
            print(line.rstrip(), file=sys.stderr, flush=True)
