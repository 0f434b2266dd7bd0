"""The engines, which do all computation: a base class, the torch reference, its CUDA twin, and the choice of one.

`Engine` is the interface: strategies say what is to be done (`rules`), an engine does it on one device. Only this
package chooses between the kernels and torch.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import torch

from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.cuda.engine import CudaEngine
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.reference.engine import ReferenceEngine
from turbogs_plugin.engine.shared import SharedEngine

__all__ = ["CompiledKernels", "Engine", "compiled_kernels", "engine_of"]


@dataclass(frozen=True)
class CompiledKernels:
    """The compiled library of kernels, for reports.

    Args:
        path: where it is expected.
        architectures: those it holds code for: ``sm_90``, ..., or PTX, ``compute_90``.
        unavailable: why it cannot run here, in one line; "" if it can.
    """

    path: Path
    architectures: tuple[str, ...]
    unavailable: str


def compiled_kernels() -> CompiledKernels:
    """The library that `engine_of` uses for CUDA tensors, or why it uses the reference instead."""
    return CompiledKernels(library.library_path(), library.architectures(), library.unavailable_reason())


def engine_of(device: torch.device, for_training: bool = False) -> SharedEngine:
    """The engine for tensors on a device: the kernels where they are compiled and run, else the torch reference.

    A warning says why, where a GPU has to do without the kernels.

    Args:
        for_training: the engine keeps its memory from pass to pass and never waits for the GPU. What it renders is
            valid until its next pass, and the caller must call `Engine.settle` before each iteration.
    """
    if device.type == "cuda":
        if not (reason := library.unavailable_reason()):
            return CudaEngine(device if for_training else None)
        warnings.warn(f"kernels are not usable ({reason}): the torch reference runs, many times slower", stacklevel=2)
    return ReferenceEngine()
