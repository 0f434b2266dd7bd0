"""What a viewer costs a training: iterations a second without one, with one that nobody looks at, and with a client."""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.live import LiveViewer
from turbogs_plugin.viewer.server import Page

WAYS = ("without", "nobody looks", "client")
"""Of each repeat, in this order."""
SIZE = (640, 480)
"""Pixels of the client's page."""
PATIENCE = 60.0
"""Seconds to wait for the client to connect."""


@dataclass
class ViewerRun:
    """One training.

    Args:
        way: one of `WAYS`.
        iterations, seconds: of training.
        frames: that the client received.
        frame_rate: of these, a second; NaN without a client.
        width: of the frame in the middle by width, pixels; 0 without a client.
        gaussians: at the end.
    """

    way: str
    iterations: int
    seconds: float
    frames: int = 0
    frame_rate: float = math.nan
    width: int = 0
    gaussians: int = 0

    @property
    def rate(self) -> float:
        """Iterations a second."""
        return self.iterations / self.seconds


@dataclass(frozen=True)
class WaySummary:
    """All runs of a way.

    Args:
        way: one of `WAYS`.
        rates: iterations a second of each run.
        changes: of each run, beside the run without a viewer of the same repeat: 0.1 is ten percent more iterations a
            second.
        frame_rate: median, frames a second; NaN without a client.
        width: median, pixels; 0 without a client.
    """

    way: str
    rates: list[float]
    changes: list[float]
    frame_rate: float
    width: float

    def change_text(self) -> str:
        """The median, with the least and the most in brackets."""
        median, least, most = (
            f"{100 * value:+.1f}" for value in (statistics.median(self.changes), min(self.changes), max(self.changes))
        )
        return f"{median} % [{least}, {most}]"


def summarised(measured: dict[str, Any]) -> list[WaySummary]:
    """What `bench_viewer` measured, way by way."""
    runs = [ViewerRun(**run) for run in measured["runs"]]
    alone, found = [run.rate for run in runs if run.way == "without"], []
    for way in WAYS:
        each = [run for run in runs if run.way == way]
        rates = [run.rate for run in each]
        changes = [rate / base - 1 for rate, base in zip(rates, alone, strict=True)]
        frame_rate, width = (statistics.median(getattr(run, name) for run in each) for name in ("frame_rate", "width"))
        found.append(WaySummary(way, rates, changes, frame_rate, width))
    return found


def bench_viewer(config: Config, scene: Scene, device: torch.device, repeats: int) -> dict[str, Any]:
    """Train several times in each way, the ways in turn.

    Args:
        config: of the training; what is `auto` is decided once.
        scene: its photos in host memory.

    Returns:
        ``scene``, its name; ``size`` of the client's page; and ``runs``, in their order.
    """
    decided = make_plan(config, scene, device).apply(config)
    _train("without", decided, scene, device)  # what happens once in a process, happens here
    runs = [_train(way, decided, scene, device) for _ in range(repeats) for way in WAYS]
    return {"scene": scene.name, "size": SIZE, "runs": [asdict(run) for run in runs]}


def viewer_lines(measured: dict[str, Any]) -> list[str]:
    """One line for each way, side by side with the training alone."""
    lines = []
    for row in summarised(measured):
        line = f"{row.way:<13} {statistics.median(row.rates):9.2f} iterations a second  {row.change_text():>24}"
        if row.way == "client":
            line += f"  {row.frame_rate:.1f} frames a second, {row.width:.0f} pixels wide"
        lines.append(f"{line}  ({', '.join(f'{rate:.2f}' for rate in row.rates)})")
    return lines


def _train(way: str, config: Config, scene: Scene, device: torch.device) -> ViewerRun:
    loop = new_loop(config, scene, device)
    begin, client = _Begin(), None
    loop.listeners = [begin]
    with ExitStack() as stack:
        if way != "without":
            page = Page("127.0.0.1", 0, training=True)
            stack.callback(page.close)
            test = place_views(scene.test, device, config.train.photos_place)
            loop.listeners.insert(0, LiveViewer(page).attach(loop.trainer, test))
        if way == "client":
            client = _start_client(page, ViewerCamera.of_view(loop.trainer.views.cameras, 0))
        loop.run()
    iterations, seconds = loop.trainer.iteration - begin.iteration, loop.clock.seconds - begin.seconds
    run = ViewerRun(way, iterations, seconds, gaussians=len(loop.trainer.gaussians))
    if client is not None:  # it ends with the page
        found = json.loads(client.communicate()[0])
        run.frames, run.width = found["frames"], int(statistics.median(found["widths"] or [0]))
        run.frame_rate = (run.frames - 1) / found["seconds"] if run.frames > 1 else 0.0
    return run


class _Begin(Listener):
    """Notes when the first iteration begins: the error maps before it are no iteration's."""

    def __init__(self) -> None:
        self.iteration, self.seconds = 0, 0.0

    def begun(self, loop: TrainingLoop) -> None:
        self.iteration, self.seconds = loop.trainer.iteration, loop.clock.seconds


def _start_client(page: Page, eye: ViewerCamera) -> subprocess.Popen:
    """A scripted client in a process of its own, connected."""
    numbers = json.dumps([eye.position, eye.wxyz, eye.fov, *SIZE])
    command = [sys.executable, "-m", "turbogs_plugin.bench.viewer_client", f"{page.url}", numbers]
    client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path.cwd())
    ends = time.perf_counter() + PATIENCE
    while not page.watched:
        if client.poll() is not None or time.perf_counter() > ends:
            client.kill()
            raise TrainingStopped("bench viewer: its client did not connect")
        time.sleep(0.02)
    return client
