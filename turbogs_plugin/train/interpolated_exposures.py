"""Exposures of photos that were not trained, by those of the training photos taken before and after them.

A camera's automatic follows the light, so a photo's exposure is nearly its neighbours'. Nothing of the photo itself is
used but its name. Deutsch et al. (PPISP, CVPR 2026) have a network predict it from the render, for the same reason: so
that test photos can be compared with a model of their scene, and not with their camera's settings.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from turbogs_plugin.scene.sequence import neighbours


def interpolated_exposures(offsets: Tensor, trained: Sequence[str], photos: Sequence[str]) -> Tensor:
    """[W, 3, 4] float32, ``A | b`` of photos: the mean of their neighbours', times how well that would have told the
    exposures of the training photos themselves.

    That factor is the slope of the least squares of the training photos' exposures against their neighbours' mean,
    within 0 .. 1: nearly 1 where exposures follow the sequence, and 0, so that all photos have the identity, where they
    differ at random, as in a collection of many people's photos. A photo without a neighbour has the identity, too.

    Args:
        offsets: [V, 3, 4], those of the training photos (`turbogs_plugin.engine.exposures.Exposures`).
        trained: [V] the training photos' names.
        photos: [W] names; a training photo gets its neighbours' exposure, not its own.
    """
    among = neighbours(trained, trained)
    between = (among.weights > 0).all(dim=1).to(offsets.device)  # [V]: not those at an end of their sequence
    own, told = offsets[between].double(), among.mean(offsets)[between].double()
    length = told.square().sum()
    slope = ((own * told).sum() / length).clamp(0.0, 1.0) if length > 0 else length
    return slope.float() * neighbours(trained, photos).mean(offsets)


def exposed(colors: Tensor, exposure: Tensor) -> Tensor:
    """[..., 3]: ``c + A c + b`` of colours c [..., 3], by an exposure [3, 4]."""
    return colors + (colors @ exposure[:, :3].T + exposure[:, 3])
