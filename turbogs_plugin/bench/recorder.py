"""Marks the steps of the trainer's own iteration, under the paper's names, without a copy of that iteration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch

from turbogs_plugin.bench.clocks import Recorder, Summary, device_times, summary
from turbogs_plugin.engine import Engine
from turbogs_plugin.engine.rendered import Rendered, RenderOptions
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

STEPS = ("budget", "GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC")
"""The paper's names, in the order of an iteration: sampling parameters, view and pixel sampling, forward, ground truth
with loss and error maps, backward to the screen, backward to the parameters with the optimizer, density control."""


class StepRecorder(Recorder):
    """Spans of the steps of iterations.

    Attributes:
        rendered, samples: of the latest iteration.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.rendered: Rendered | None = None
        self.samples: PixelSamples | None = None

    def summaries(self) -> dict[str, dict[str, Summary]]:
        """Step -> times on the device and on the host, after the device has been waited for."""
        return {
            name: {
                "device": device_times(self.spans[name]),
                "host": summary([first.host_until(last) for first, last in self.spans[name]]),
            }
            for name in ("iteration", *STEPS)
            if name in self.spans
        }


class RecordedEngine:
    """Another engine whose forward passes are recorded, and the backward passes of what it renders."""

    def __init__(self, engine: Engine, recorder: StepRecorder) -> None:
        self._engine, self._recorder = engine, recorder
        self._render = recorder.timed("FWD", engine.render)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def render(self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions) -> Rendered:
        rendered = self._render(gaussians, cameras, samples, options)
        self._recorder.rendered, self._recorder.samples = rendered, samples
        rendered.backward = self._recorder.timed("BWD", rendered.backward)
        return rendered


@contextmanager
def recorded(trainer: Trainer, recorder: StepRecorder) -> Iterator[Callable[[], None]]:
    """While entered, the steps of this trainer's iterations are recorded; gives its iteration."""
    timed = recorder.timed
    replacements = (
        (trainer.schedule, "query", timed("budget", trainer.schedule.query)),
        (trainer.view_sampler, "select", timed("GVS", trainer.view_sampler.select)),
        (trainer.pixel_sampler, "sample", timed("EPS", trainer.pixel_sampler.sample)),
        (trainer, "engine", RecordedEngine(trainer.engine, recorder)),
        (trainer, "supervise", timed("gather+L+E", trainer.supervise)),
        (trainer, "update", timed("solve+update", trainer.update)),
        (trainer.density, "update", timed("EDC", trainer.density.update)),
    )
    with ExitStack() as stack:
        for owner, name, replacement in replacements:
            stack.enter_context(patch.object(owner, name, replacement))
        yield timed("iteration", trainer.step)
