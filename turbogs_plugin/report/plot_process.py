"""Plots of a run's report, drawn in a process of their own.

matplotlib takes half a second to import, several times that where Python keeps no bytecode files. A thread that imports
it takes turns with all others on Python's lock, so that decoding photos and the first operations of torch wait for it;
a process imports it on another core.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class SecondsPlot:
    """One measure against seconds of training.

    Args:
        path: the PNG.
        seconds, values: of the evaluations, in order.
        label: of the vertical axis, with the unit.
        title: of the plot.
    """

    path: str
    seconds: list[float]
    values: list[float]
    label: str
    title: str

    def draw(self) -> None:
        """In this process."""
        from turbogs_plugin.report.plots import plot_against_seconds

        plot_against_seconds(Path(self.path), self.seconds, self.values, self.label, self.title)


class PlotProcess:
    """A process that imports what plots need, and waits to be told what to draw. Leaving it ends the process.

    It ends by itself where this one is killed, as nobody can write to it any more.
    """

    def __init__(self) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        # In a session of its own: Ctrl-C is for the training, which then tells this process.
        command = [sys.executable, "-m", __name__]
        self._process = subprocess.Popen(command, **pipes, text=True, encoding="utf-8", start_new_session=True)

    def begin(self, plots: Sequence[SecondsPlot]) -> None:
        """Have these drawn. Once, as the process ends with it."""
        with suppress(BrokenPipeError), self._process.stdin as pipe:  # a process that has ended says so in `end`
            pipe.write(json.dumps([asdict(plot) for plot in plots]))

    def end(self) -> bool:
        """Wait until all is drawn. Whether it is."""
        return self._process.wait() == 0

    def __enter__(self) -> PlotProcess:
        return self

    def __exit__(self, *error: object) -> None:
        if not self._process.stdin.closed:  # nothing is to be drawn
            self._process.kill()
            self._process.stdin.close()
        self._process.wait()


def main() -> None:
    """What the process does."""
    import turbogs_plugin.report.plots  # noqa: F401  # while nothing is asked for yet

    for plot in json.loads(sys.stdin.read() or "[]"):
        SecondsPlot(**plot).draw()


if __name__ == "__main__":
    main()
