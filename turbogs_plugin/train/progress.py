"""What a run shows while it trains: a bar on a terminal, a line per evaluation elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from turbogs_plugin.device import memory_bytes
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.trainer import Trainer

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

REFRESH_SECONDS = 0.1
"""Time between two updates of the bar, so that fast iterations are not slowed down."""


PATIENCE_SECONDS = 2.0
"""Photos that are loaded sooner are not counted for the user."""
LINE_SECONDS = 10.0
"""Time between two lines about photos, where stderr is no terminal."""

BarType = TypeVar("BarType", bound="TerminalBar")


class TerminalBar(Listener):
    """A bar on stderr that follows the iterations, if stderr is a terminal; otherwise nothing, and rich stays unloaded.

    Args:
        transient: whether the bar disappears at the end.
        task: first values of the bar.
    """

    def __init__(self, transient: bool = False, **task: Any) -> None:
        self._next_refresh = 0.0
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress

            console = Console(stderr=True)
            self._bar = Progress(*self._columns(), console=console, auto_refresh=False, transient=transient)
            self._task = self._bar.add_task("", **task)

    def _columns(self) -> Sequence[ProgressColumn]:
        """The columns of the bar, for a class to override."""
        raise NotImplementedError

    def __enter__(self: BarType) -> BarType:
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
        self._show(loop.trainer, **self._refreshed(loop))

    def _refreshed(self, loop: TrainingLoop) -> dict[str, str]:
        """Further columns of the bar, for a class to override."""
        return {}

    def _show(self, trainer: Trainer, **columns: str) -> None:
        columns["gaussians"] = f"{len(trainer.gaussians):,}"
        self._bar.update(self._task, completed=trainer.iteration, total=trainer.iterations, **columns)
        self._bar.refresh()


class LoadingProgress:
    """Counts photos on stderr while they are decoded: in one line that is overwritten, or a line now and then."""

    def __init__(self) -> None:
        self._start: float | None = None  # when the first photo is decoded: lenses and masks come before
        self._next = 0.0

    def __call__(self, loaded: int, total: int) -> None:
        """So many photos of `total` are decoded."""
        now, terminal = time.perf_counter(), sys.stderr.isatty()
        if self._start is None:
            self._start, self._next = now, now + PATIENCE_SECONDS
            return
        begun = self._next > self._start + PATIENCE_SECONDS
        if now < self._next and not (begun and terminal and loaded == total):
            return
        self._next = now + (REFRESH_SECONDS if terminal else LINE_SECONDS)
        left = (now - self._start) / (loaded - 1) * (total - loaded)
        text = f"{loaded} of {total} photos decoded, about {left:.0f} s left"
        if not terminal:
            print(text, file=sys.stderr, flush=True)
        else:
            print(f"\r{text}\033[K" if loaded < total else "\r\033[K", end="", file=sys.stderr, flush=True)


class TrainingProgress(TerminalBar):
    """Shows iteration, test PSNR, number of Gaussians, iterations a second of training, memory and seconds left on
    stderr.

    Args:
        total: T, as first known.
        iteration: where the run begins.
    """

    def __init__(self, total: int, iteration: int = 0) -> None:
        unknown = dict.fromkeys(("psnr", "gaussians", "speed", "memory", "left"), "-")
        super().__init__(total=total, completed=iteration, warning="", **unknown)
        self._first: tuple[int, float] | None = None  # iteration and seconds of training where the speed counts from

    def _columns(self) -> Sequence[ProgressColumn]:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.table import Column

        numbers = "PSNR {task.fields[psnr]} dB  {task.fields[gaussians]} Gaussians  {task.fields[speed]} it/s"
        numbers += "  {task.fields[memory]}  {task.fields[left]} s left"
        # Where the terminal is narrow, the columns that may wrap give way.
        return (
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            BarColumn(),
            TextColumn(numbers),
            TextColumn("{task.fields[warning]}", style="bold red", table_column=Column()),
        )

    def advanced(self, loop: TrainingLoop) -> None:
        if self._bar is not None and self._first is None:
            self._first = (loop.trainer.iteration, loop.clock.now())
        super().advanced(loop)

    def _refreshed(self, loop: TrainingLoop) -> dict[str, str]:
        trainer, (first, began) = loop.trainer, self._first
        done, seconds = trainer.iteration - first, loop.clock.now() - began
        memory = f"{memory_bytes(trainer.device) / 2**30:.2f} GiB"
        if done < 1 or seconds <= 0:
            return {"memory": memory}
        speed = done / seconds
        left = (trainer.iterations - trainer.iteration) / speed
        return {"memory": memory, "speed": f"{speed:.3g}" if speed < 100 else f"{speed:.0f}", "left": f"{left:,.0f}"}

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        warning, total = describe_nonfinite(evaluation), loop.trainer.iterations
        if self._bar is not None:
            self._show(loop.trainer, psnr=f"{evaluation.psnr:.2f}", warning=warning)
            return
        print(
            f"iteration {evaluation.iteration:>{len(str(total))}}/{total}  "
            f"{evaluation.train_seconds:7.1f} s  test PSNR {evaluation.psnr:5.2f} dB  SSIM {evaluation.ssim:.4f}  "
            f"{evaluation.num_gaussians} Gaussians" + (f"  {warning}" if warning else ""),
            file=sys.stderr,
            flush=True,
        )


def describe_nonfinite(evaluation: Evaluation) -> str:
    """The counts of non-finite events in words; empty if there were none."""
    counts = {"non-finite losses": evaluation.nonfinite_losses, "skipped updates": evaluation.skipped_updates}
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)
