"""Marks the steps of the trainer's own iteration, under the paper's names, without a copy of that iteration."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

from turbogs_plugin.bench.clocks import Mark, Summary, summary
from turbogs_plugin.engine import Engine
from turbogs_plugin.engine.rendered import Rendered, RenderOptions
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

STEPS = ("budget", "GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC")
"""The paper's names, in the order of an iteration: sampling parameters, view and pixel sampling, forward, ground truth
with loss and error maps, backward to the screen, backward to the parameters with the optimizer, density control."""


class StepRecorder:
    """Spans of the steps of iterations.

    Attributes:
        rendered, samples: of the latest iteration.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.spans: dict[str, list[tuple[Mark, Mark]]] = defaultdict(list)
        self.rendered: Rendered | None = None
        self.samples: PixelSamples | None = None

    def timed(self, name: str, function: Callable) -> Callable:
        """The function, with its spans recorded under a name."""

        def call(*arguments: Any, **keywords: Any) -> Any:
            first = Mark(self.device)
            result = function(*arguments, **keywords)
            self.spans[name].append((first, Mark(self.device)))
            return result

        return call

    def summaries(self) -> dict[str, dict[str, Summary]]:
        """Step -> times on the device and on the host, after the device has been waited for."""
        return {
            name: {
                "device": summary([first.until(last) for first, last in self.spans[name]]),
                "host": summary([first.host_until(last) for first, last in self.spans[name]]),
            }
            for name in ("iteration", *STEPS)
            if name in self.spans
        }


class TimedEngine:
    """Another engine whose every call is recorded; what it renders records its backward pass too.

    Args:
        engine: of the trainer.
    """

    def __init__(self, engine: Engine, recorder: StepRecorder) -> None:
        self._engine, self._recorder = engine, recorder
        self.draw, self.evaluate, self.learn, self.settle = engine.draw, engine.evaluate, engine.learn, engine.settle
        self.supervise = recorder.timed("gather+L+E", engine.supervise)
        self.update = recorder.timed("solve+update", engine.update)
        self._render = recorder.timed("FWD", engine.render)

    def render(self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions) -> Rendered:
        rendered = self._render(gaussians, cameras, samples, options)
        self._recorder.rendered, self._recorder.samples = rendered, samples
        rendered.backward = self._recorder.timed("BWD", rendered.backward)
        return rendered

    @property
    def bytes_held(self) -> int:
        return self._engine.bytes_held


@contextmanager
def recorded(trainer: Trainer, recorder: StepRecorder) -> Iterator[Callable[[], None]]:
    """While entered, the steps of this trainer's iterations are recorded; gives its iteration."""
    timed = recorder.timed
    replacements = [
        (trainer, "engine", TimedEngine(trainer.engine, recorder)),
        (trainer.schedule, "query", timed("budget", trainer.schedule.query)),
        (trainer.view_sampler, "select", timed("GVS", trainer.view_sampler.select)),
        (trainer.pixel_sampler, "sample", timed("EPS", trainer.pixel_sampler.sample)),
        (trainer.density, "update", timed("EDC", trainer.density.update)),
    ]
    if trainer.loss.terms is None:  # its own code is not the engine's
        replacements.append((trainer, "supervise", timed("gather+L+E", trainer.supervise)))
    if trainer.optimizer.rule(trainer.now) is None:
        replacements.append((trainer, "update", timed("solve+update", trainer.update)))
    with ExitStack() as stack:
        for owner, name, replacement in replacements:
            stack.enter_context(_replaced(owner, name, replacement))
        yield timed("iteration", trainer.step)


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Another attribute for a while."""
    own = name in vars(owner)
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)
