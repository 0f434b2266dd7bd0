"""Devices: numbers sent to them, waits for them, peak memory, unused memory freed; the processor's cores."""

from __future__ import annotations

import gc
import os
import shutil
import sys
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def on_device(numbers: Sequence[int] | np.ndarray, device: torch.device) -> Tensor:
    """Numbers of the host as a tensor on a device, sent to a GPU without waiting for it."""
    tensor = torch.as_tensor(numbers)
    return tensor if device.type == "cpu" else tensor.pin_memory().to(device, non_blocking=True)


def synchronize(device: torch.device) -> None:
    """Wait for the GPU, so that a clock read next counts what was asked for; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def processor_cores() -> int:
    """The cores that this process may use: a container or a job may have fewer than the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_note() -> str:
    """A line about a training on the CPU."""
    note = "training on the CPU takes hundreds of times as long as on a GPU: --factor 4 and --time-budget shorten it"
    if torch.version.cuda is None and shutil.which("nvidia-smi"):
        note += "; an NVIDIA GPU is here, and this PyTorch is built without CUDA: install one with it (pytorch.org)"
    return note


def free_device_memory(device: torch.device) -> None:
    """Free a GPU's memory that nothing refers to any more, so that it does not count in the next measurement."""
    if device.type == "cuda":
        gc.collect()
        torch.cuda.empty_cache()


def free_bytes(device: torch.device) -> int:
    """Memory of a GPU that this process may still take: what nobody has, and what torch keeps unused."""
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + unused


def peak_memory_bytes(device: torch.device) -> int:
    """Peak of the tensors' memory on a GPU, without what processes share (`distributed.peer_memory`), or of this
    process on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    import resource  # not on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
