"""Ground truth, loss and error maps of an iteration (steps 4, 6, 7 of Algorithm 1), in one kernel where possible."""

from __future__ import annotations

from torch import Tensor

from turbogs_plugin import kernels, training_kernels
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene import Photos
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.types import LossOutput, PixelSamples, Step


def supervise(
    loss: SparseLoss,
    colors: Tensor,
    photos: Photos,
    samples: PixelSamples,
    maps: ErrorMaps,
    step: Step,
    overflow: Tensor | None = None,
) -> LossOutput:
    """Compare rendered samples with the photos, and let the error maps learn from it.

    On CUDA, a loss that offers ``kernel_terms()`` is evaluated by the kernel that also gathers the truth and updates
    the maps; a test holds the two ways equal.

    Args:
        loss: of the run.
        colors: [P, 3] rendered.
        photos: of all training views, on the device of `colors`.
        samples: what `colors` are.
        maps: updated in place.
        step: gives the stamp.
        overflow: [1] int32 on the device; where it is not 0, the maps stay as they are.
    """
    kernel_terms = getattr(loss, "kernel_terms", None)
    if colors.is_cuda and kernel_terms is not None and kernels.available():
        return training_kernels.sparse_loss(
            colors, photos.colors, samples, kernel_terms(), update=training_kernels.MapUpdate(maps, step, overflow)
        )
    output = loss(colors, photos.gather(samples), samples)
    maps.update(samples, output.pixel_errors, step)
    return output
