"""Marks calls of functions, above all the steps of the trainer's own iteration, without a copy of that iteration."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch

from turbogs_plugin.bench.clocks import Mark, Span, Summary, device_times, summary
from turbogs_plugin.engine.rendered import Rendered
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

STEPS = ("budget", "GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC")
"""The paper's names, in the order of an iteration: sampling parameters, view and pixel sampling, forward, ground truth
with loss and error maps, backward to the screen, backward to the parameters with the optimizer, density control."""


class Recorder:
    """Spans of function calls.

    Attributes:
        spans: of each name, in the order of the calls.
        rendered, samples: of the latest forward pass that `passes` recorded.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.spans: dict[str, list[Span]] = defaultdict(list)
        self.rendered: Rendered | None = None
        self.samples: PixelSamples | None = None

    def timed(self, name: str, function: Callable) -> Callable:
        """The function, with the spans of its calls recorded under a name."""

        def call(*arguments: Any, **keywords: Any) -> Any:
            first = Mark(self.device)
            result = function(*arguments, **keywords)
            self.spans[name].append((first, Mark(self.device)))
            return result

        return call

    @contextmanager
    def calls(self, *places: tuple[Any, str, str]) -> Iterator[None]:
        """While entered, calls are recorded: for each place an owner, the name of its function, and of the span."""
        with ExitStack() as stack:
            for owner, function, name in places:
                stack.enter_context(patch.object(owner, function, self.timed(name, getattr(owner, function))))
            yield

    @contextmanager
    def passes(self, trainer: Trainer, forward: str, backward: str) -> Iterator[None]:
        """While entered, the trainer's forward passes are recorded, and the backward passes of what they render."""
        timed = self.timed(forward, trainer.engine.render)

        def render(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, *options: Any) -> Rendered:
            self.rendered, self.samples = timed(gaussians, cameras, samples, *options), samples
            self.rendered.backward = self.timed(backward, self.rendered.backward)
            return self.rendered

        with patch.object(trainer.engine, "render", render):
            yield

    def summaries(self) -> dict[str, dict[str, Summary]]:
        """Step -> times on the device and on the host, after the device has been waited for."""
        summaries = {}
        for name in (name for name in ("iteration", *STEPS) if name in self.spans):
            on_host = summary([first.host_until(last) for first, last in self.spans[name]])
            summaries[name] = {"device": device_times(self.spans[name]), "host": on_host}
        return summaries


@contextmanager
def recorded(trainer: Trainer, recorder: Recorder) -> Iterator[Callable[[], None]]:
    """While entered, the steps of this trainer's iterations are recorded; gives its iteration."""
    places = (
        (trainer.schedule, "query", "budget"),
        (trainer.view_sampler, "select", "GVS"),
        (trainer.pixel_sampler, "sample", "EPS"),
        (trainer, "supervise", "gather+L+E"),
        (trainer, "update", "solve+update"),
        (trainer.density, "update", "EDC"),
    )
    with recorder.passes(trainer, "FWD", "BWD"), recorder.calls(*places):
        yield recorder.timed("iteration", trainer.step)
