"""Ground truth, loss and error maps of an iteration (steps 4, 6, 7 of Algorithm 1), in one kernel where possible."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.types import LossOutput, Step


def supervise(
    loss: SparseLoss,
    colors: Tensor,
    truth: PhotoSamples,
    maps: ErrorMaps,
    step: Step,
    overflow: Tensor | None = None,
    nonfinite_losses: Tensor | None = None,
) -> LossOutput:
    """Compare rendered samples with the photos, and let the error maps learn from it.

    On CUDA, a loss that offers ``kernel_terms()`` is evaluated by the kernel that also updates the maps, and gathers
    the truth where photos and maps of each view begin at the same pixel (with only one of the two offloaded, they do
    not); tests hold the ways equal.

    Args:
        loss: of the run.
        colors: [P, 3] rendered.
        truth: the photos at the samples, on the device of `colors`.
        maps: updated in place.
        step: gives the stamp.
        overflow: [1] int32 on the device; where it is not 0, nothing was drawn: the maps stay as they are, and the loss
            does not count as lost. It is never read on the host.
        nonfinite_losses: [] int64 on the device; 1 is added if the loss is not finite.
    """
    kernel_terms = getattr(loss, "kernel_terms", None)
    if colors.is_cuda and kernel_terms is not None and kernels.available():
        aligned = len(truth.photos.colors) == len(maps.errors) and np.array_equal(
            truth.starts, maps.offsets[list(truth.samples.view_ids)]
        )
        return training_kernels.sparse_loss(
            colors,
            truth.photos.colors if aligned else truth.colors(),
            truth.samples,
            kernel_terms(),
            update=training_kernels.MapUpdate(maps, step, overflow),
            nonfinite_losses=nonfinite_losses,
        )
    output = loss(colors, truth.colors(), truth.samples)
    pixel_errors, nonfinite = output.pixel_errors, ~output.loss.isfinite()
    if overflow is not None:
        lost = overflow != 0
        pixel_errors = torch.where(lost, torch.nan, pixel_errors)  # of which the maps learn nothing
        nonfinite &= ~lost[0]
    maps.update(truth.samples, pixel_errors, step)
    if nonfinite_losses is not None:
        nonfinite_losses += nonfinite
    return output
