"""The engines, which do all computation: a base class, the torch reference, its CUDA twin, and the choice of one.

`Engine` is the interface: strategies say what is to be done (`rules`), an engine does it on one device. Only this
package chooses between the kernels and torch.
"""

from __future__ import annotations

import warnings

import torch

from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.cuda.engine import CudaEngine
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.reference.raster import rasterize_reference, screen_gradients
from turbogs_plugin.engine.shared import SharedEngine

__all__ = ["Engine", "ReferenceEngine", "engine_of", "library"]


class ReferenceEngine(SharedEngine):
    """`Engine` in torch, the definition of every result, on any device and in float32 or float64.

    It keeps nothing between calls and never loses an iteration.
    """

    draw = staticmethod(draw_pixels)
    render = staticmethod(rasterize_reference)
    screen_gradients = staticmethod(screen_gradients)
    evaluate = staticmethod(sparse_loss)


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
