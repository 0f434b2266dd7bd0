"""What a sweep shows: for each cell a line with the time left, and on a terminal a bar of the present cell."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from turbogs_plugin.study.grid import CellKey
from turbogs_plugin.study.results import CellResult, Failure
from turbogs_plugin.train.progress import TerminalBar

if TYPE_CHECKING:
    from rich.progress import ProgressColumn


class SweepProgress(TerminalBar):
    """Shows cells as they finish, on stderr.

    Args:
        total: cells to train.
        kept: cells that were there already.
    """

    def __init__(self, total: int, kept: int) -> None:
        self.total, self.done = total, 0
        self._begun, self._trained, self._seconds = time.perf_counter(), 0, 0.0
        super().__init__(transient=True, total=None, left="")
        if kept:
            self._say(f"{kept} finished cells are kept")

    def _columns(self) -> Sequence[ProgressColumn]:
        from rich.progress import BarColumn, TextColumn

        return (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"))

    def begin(self, key: CellKey) -> None:
        """Called before a cell."""
        self._begun = time.perf_counter()
        if self._bar is not None:
            self._bar.reset(self._task, total=None, description=str(key), left=self._left())

    def ended(self, outcome: CellResult | Failure) -> None:
        """Called after a cell, finished or broken."""
        if isinstance(outcome, Failure):
            text = f"FAILED: {outcome.reason}"
        else:
            self._trained += 1
            self._seconds += time.perf_counter() - self._begun
            final = outcome.final
            text = f"{final.psnr:.2f} dB in {final.train_seconds:.1f} s, {final.num_gaussians} Gaussians"
        self.done += 1
        left = self._left()
        self._say(f"[{self.done}/{self.total}] {outcome.key}: {text}" + (f"; {left}" if left else ""))

    def ended_elsewhere(self) -> None:
        """Called in the place of `ended` for a cell that another process has trained."""
        self.total -= 1

    def _left(self) -> str:
        """The time left in words, by the mean time of the cells trained here; "" where there is none yet."""
        if not self._trained or self.done == self.total:
            return ""
        seconds = round(self._seconds / self._trained * (self.total - self.done))
        return f"about {seconds // 60} min {seconds % 60:02d} s left"

    def _say(self, text: str) -> None:
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)
