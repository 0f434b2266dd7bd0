"""Times of functions on a GPU or a CPU, with their spread, and of the steps of the trainer's own iteration."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.render_pass import Rendered
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

BUSY_CYCLES = 20_000_000
"""Clock cycles for which the GPU is kept busy before what is timed, so that the host has enqueued all of it by then."""

WARMUP_CALLS = 3

BLOCKS = 5
"""Number of blocks of calls over which wall times are measured; their spread is the spread of the blocks."""

STEPS = ("budget", "GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC")
"""The paper's names, in the order of an iteration: sampling parameters, view and pixel sampling, forward, ground truth
with loss and error maps, backward to the screen, backward to the parameters with the optimizer, density control."""

Summary = dict[str, float]


def summary(milliseconds: Sequence[float]) -> Summary:
    """Median, and the 10th and 90th percentile."""
    low, high = np.percentile(milliseconds, [10, 90])
    return {"median_ms": statistics.median(milliseconds), "p10_ms": float(low), "p90_ms": float(high)}


class Mark:
    """A moment on the device's clock. `host`: when the host enqueued it, in seconds."""

    def __init__(self, device: torch.device) -> None:
        self.event: torch.cuda.Event | None = None
        if device.type == "cuda":
            self.event = torch.cuda.Event(enable_timing=True)
            self.event.record(torch.cuda.current_stream(device))
        self.host = time.perf_counter()

    def until(self, later: Mark) -> float:
        """Milliseconds on the device. A GPU must have been waited for."""
        if self.event is None or later.event is None:
            return self.host_until(later)
        return self.event.elapsed_time(later.event)

    def host_until(self, later: Mark) -> float:
        """Milliseconds on the host."""
        return 1e3 * (later.host - self.host)


Span = tuple[Mark, Mark]


def device_times(spans: Iterable[Span]) -> Summary:
    """Spans on the device. A GPU must have been waited for."""
    return summary([first.until(last) for first, last in spans])


def keep_busy(device: torch.device) -> None:
    """Wait for the GPU, then keep it busy for a while; nothing on a CPU."""
    synchronize(device)
    if device.type == "cuda":
        torch.cuda._sleep(BUSY_CYCLES)


def measure(function: Callable[[], object], repeats: int, device: torch.device) -> Summary:
    """Time of the device for `function`: on a GPU without the gaps in which it waits for the host."""
    for _ in range(WARMUP_CALLS if device.type == "cuda" else 1):
        function()
    spans = []
    for _ in range(repeats):
        keep_busy(device)
        first = Mark(device)
        function()
        spans.append((first, Mark(device)))
    synchronize(device)
    return device_times(spans)


def back_to_back(function: Callable[[], object], repeats: int, device: torch.device) -> Summary:
    """Wall time of a call among calls that follow each other without a pause, as in training; spread over blocks."""
    synchronize(device)
    spans = []
    for _ in range(BLOCKS):
        start = time.perf_counter()
        for _ in range(repeats):
            function()
        synchronize(device)
        spans.append(1e3 * (time.perf_counter() - start) / repeats)
    return summary(spans)


def copy_bandwidth(device: torch.device) -> float:
    """Bytes a second that a large copy reads and writes."""
    source = torch.empty(1 << (30 if device.type == "cuda" else 26), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() / (1e-3 * measure(lambda: target.copy_(source), 10, device)["median_ms"])


class Recorder:
    """Spans of function calls, by name; and the latest forward pass of a trainer that is `recorded`."""

    rendered: Rendered
    samples: PixelSamples

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.spans: dict[str, list[Span]] = defaultdict(list)

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
        """While entered, calls are recorded. Each place is an owner, the name of its function, the name of the span."""
        with ExitStack() as stack:
            for owner, function, name in places:
                stack.enter_context(patch.object(owner, function, self.timed(name, getattr(owner, function))))
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
    forward = recorder.timed("FWD", trainer.engine.render)

    def render(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, *options: Any) -> Rendered:
        rendered: Any = forward(gaussians, cameras, samples, *options)
        rendered.backward = recorder.timed("BWD", rendered.backward)
        recorder.rendered, recorder.samples = rendered, samples
        return rendered

    places = (
        (trainer.schedule, "query", "budget"),
        (trainer.view_sampler, "select", "GVS"),
        (trainer.pixel_sampler, "sample", "EPS"),
        (trainer, "supervise", "gather+L+E"),
        (trainer, "update", "solve+update"),
        (trainer.density, "update", "EDC"),
    )
    with patch.object(trainer.engine, "render", render), recorder.calls(*places):
        yield recorder.timed("iteration", trainer.step)
