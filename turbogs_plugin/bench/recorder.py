"""Marks the steps of the trainer's own iteration, under the paper's names, without a copy of that iteration."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

from turbogs_plugin.bench.clocks import Mark, Summary, summary
from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.engine.rendering import Rendered
from turbogs_plugin.train import trainer as trainer_module
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import PixelSamples

STEPS = ("budget", "GVS", "EPS", "gather", "FWD", "L", "E", "gather+L+E", "BWD", "solve+update", "EDC")
"""The paper's names, in the order of an iteration: sampling parameters, view and pixel sampling, ground truth, forward,
loss, error maps, backward, optimizer, density control. The kernels do three of them at once."""


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


@contextmanager
def recorded(trainer: Trainer, recorder: StepRecorder) -> Iterator[Callable[[], None]]:
    """While entered, the steps of this trainer's iterations are recorded; gives its iteration."""
    timed = recorder.timed
    at_once = recorder.device.type == "cuda" and kernels.available() and hasattr(trainer.loss, "kernel_terms")

    def rasterize(gaussians, cameras, samples, **keywords) -> Rendered:
        rendered = original(gaussians, cameras, samples, **keywords)
        rendered.backward = timed("BWD", rendered.backward)
        recorder.rendered, recorder.samples = rendered, samples
        return rendered

    original = trainer_module.rasterize
    replacements = [
        (trainer.schedule, "query", timed("budget", trainer.schedule.query)),
        (trainer.view_sampler, "select", timed("GVS", trainer.view_sampler.select)),
        (trainer.pixel_sampler, "sample", timed("EPS", trainer.pixel_sampler.sample)),
        (trainer_module, "rasterize", timed("FWD", rasterize)),
        (trainer.optimizer, "step", timed("solve+update", trainer.optimizer.step)),
        (trainer.density, "update", timed("EDC", trainer.density.update)),
    ]
    if at_once:
        replacements.append((trainer_module, "supervise", timed("gather+L+E", trainer_module.supervise)))
    else:
        replacements += [
            (trainer.views.photos, "gather", timed("gather", trainer.views.photos.gather)),
            (trainer, "loss", timed("L", trainer.loss)),
            (trainer.maps, "update", timed("E", trainer.maps.update)),
        ]
    with ExitStack() as stack:
        for owner, name, function in replacements:
            stack.enter_context(_replaced(owner, name, function))
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
