"""Times of functions on a GPU or a CPU, with their spread."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from turbogs_plugin.device import synchronize

BUSY_CYCLES = 20_000_000
"""Clock cycles for which the GPU is kept busy before what is timed, so that the host has enqueued all of it by then."""

WARMUP_CALLS = 3

BLOCKS = 5
"""Wall times are measured over so many blocks of calls; their spread is that of the blocks."""

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
        return self.host_until(later) if self.event is None else self.event.elapsed_time(later.event)

    def host_until(self, later: Mark) -> float:
        """Milliseconds on the host."""
        return 1e3 * (later.host - self.host)


Span = tuple[Mark, Mark]


def device_times(spans: Iterable[Span]) -> Summary:
    """The summary of spans on the device. A GPU must have been waited for."""
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
    """Bytes read and written in a second by a large copy."""
    source = torch.empty(1 << (30 if device.type == "cuda" else 26), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() / (1e-3 * measure(lambda: target.copy_(source), 10, device)["median_ms"])
