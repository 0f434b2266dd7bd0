"""What a run shows while it trains: a bar on a terminal, a line an evaluation elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop

REFRESH_SECONDS = 0.1
"""Between two updates of the bar, so that it costs a fast iteration nothing."""


class TrainingProgress(Listener):
    """Shows iteration, test PSNR, number of Gaussians and time left on stderr.

    Args:
        total: T, as known at first.
        iteration: where the run begins.
    """

    def __init__(self, total: int, iteration: int = 0) -> None:
        self._next_refresh = 0.0
        self._bar = None
        if sys.stderr.isatty():
            self._bar = Progress(
                MofNCompleteColumn(),
                BarColumn(),
                TextColumn("test PSNR {task.fields[psnr]} dB · {task.fields[gaussians]} Gaussians"),
                TimeElapsedColumn(),
                TextColumn("·"),
                TimeRemainingColumn(),
                TextColumn("left"),
                TextColumn("{task.fields[warning]}", style="bold red"),
                console=Console(stderr=True),
                auto_refresh=False,
            )
            self._task = self._bar.add_task("", total=total, completed=iteration, psnr="-", gaussians="-", warning="")

    def __enter__(self) -> TrainingProgress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advanced(self, loop: TrainingLoop) -> None:
        if self._bar is None or time.perf_counter() < self._next_refresh:
            return
        self._next_refresh = time.perf_counter() + REFRESH_SECONDS
        trainer = loop.trainer
        gaussians = f"{len(trainer.gaussians):,}"
        self._bar.update(self._task, completed=trainer.iteration, total=trainer.iterations, gaussians=gaussians)
        self._bar.refresh()

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        warning, total = describe_nonfinite(evaluation), loop.trainer.iterations
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=evaluation.iteration,
                total=total,
                psnr=f"{evaluation.psnr:.2f}",
                gaussians=f"{evaluation.num_gaussians:,}",
                warning=warning,
            )
            self._bar.refresh()
            return
        print(
            f"iteration {evaluation.iteration:>{len(str(total))}}/{total}  "
            f"{evaluation.train_seconds:7.1f} s  test PSNR {evaluation.psnr:5.2f} dB  SSIM {evaluation.ssim:.4f}  "
            f"{evaluation.num_gaussians} Gaussians" + (f"  {warning}" if warning else ""),
            file=sys.stderr,
            flush=True,
        )


def describe_nonfinite(evaluation: Evaluation) -> str:
    """The counts of non-finite events in words; empty where there were none."""
    parts = []
    if evaluation.nonfinite_losses:
        parts.append(f"{evaluation.nonfinite_losses} non-finite losses")
    if evaluation.skipped_updates:
        parts.append(f"{evaluation.skipped_updates} skipped updates")
    return ", ".join(parts)
