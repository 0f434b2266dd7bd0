"""Exposures of photos that were not trained, by those of the training photos taken before and after them.

A camera's automatic follows the light, so a photo's exposure is nearly its neighbours'. Nothing of the photo itself is
used but its name. Deutsch et al. (PPISP, CVPR 2026) have a network predict it from the render, for the same reason: so
that test photos can be compared with a model of their scene, and not with their camera's settings.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from turbogs_plugin.scene.sequence import Neighbours, PhotoOrder


def interpolated_exposures(offsets: Tensor, trained: Sequence[str], photos: Sequence[str]) -> Tensor:
    """[W, 3, 4] float32, ``A | b`` of photos: the mean of their neighbours', times how well that tells exposures.

    How well is measured on the training photos themselves, as if each were left out together with all that are nearer
    than the photo's neighbour is (rounded up to a power of two): the slope of the least squares of their exposures
    against their neighbours' mean, within 0 .. 1. It is nearly 1 where exposures follow the sequence, and 0, which
    gives the identity, where they differ at random, as in a collection of many people's photos, or where a long part of
    the sequence is missing. A photo without a neighbour has the identity, too.

    Args:
        offsets: [V, 3, 4], those of the training photos (`turbogs_plugin.engine.exposures.Exposures`).
        trained: [V] the training photos' names.
        photos: [W] names; a training photo gets its neighbours' exposure, not its own.
    """
    order = PhotoOrder([*trained, *photos])
    found = order.neighbours(trained, photos)
    told = found.mean(offsets)
    steps = 2 ** found.distances.clamp(min=1).log2().ceil().long()  # [W]
    for apart in steps.unique().tolist():
        there = (steps == apart).to(offsets.device)
        told[there] *= _slope(offsets, order.neighbours(trained, trained, apart))
    return told


def _slope(offsets: Tensor, among: Neighbours) -> float:
    """That of photos' exposures [V, 3, 4] against their neighbours' mean; 0 where no photo has one on either side."""
    between = (among.weights > 0).all(dim=1).to(offsets.device)  # [V]
    own, told = offsets[between].double(), among.mean(offsets)[between].double()
    length = float(told.square().sum())
    return min(1.0, max(0.0, float((own * told).sum()) / length)) if length > 0 else 0.0


def exposed(colors: Tensor, exposure: Tensor) -> Tensor:
    """[..., 3]: ``c + A c + b`` of colours c [..., 3], by an exposure [3, 4]."""
    return colors + (colors @ exposure[:, :3].T + exposure[:, 3])
