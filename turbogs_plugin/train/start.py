"""Starting a device beside other work: CUDA takes a second or more until it answers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import torch

from turbogs_plugin.device import synchronize
from turbogs_plugin.engine import compiled_kernels


@contextmanager
def starting(resolve: Callable[[], torch.device]) -> Iterator[Future[torch.device]]:
    """While entered, a thread starts a device and loads its kernels.

    Args:
        resolve: says which device; what it raises is raised by the future.

    Yields:
        The device, started.
    """

    def start() -> torch.device:
        device = resolve()
        synchronize(device)  # makes CUDA's context, and takes no memory through torch
        if device.type == "cuda":
            compiled_kernels()
        return device

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(start)
