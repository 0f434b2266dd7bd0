"""The order of the rows: along a curve through space, so that what lies close together is close in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.types import Gaussians, RowUpdate, Step

BITS = 21
"""Bits of a coordinate: three coordinates fill 63 bits."""
SPREADS = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two empty bits behind each of 21."""


def in_order_of_space(update: RowUpdate, gaussians: Gaussians, step: Step) -> RowUpdate:
    """The same change with its new rows in the order of space; for whoever applies an update, before it does.

    Splats of a tile are gathered, and added to, by row: what is seen together should be read together. After
    `Step.refine_until` the change stays as it is: Gaussians are then only removed, which leaves the others in order.

    Args:
        update: a change of `gaussians`.
        gaussians: the model before it, about the cameras' centre.
        step: when.
    """
    if step.iteration > step.refine_until:
        return update
    means = update.values["means"] if "means" in update.values else gaussians.means[update.source]
    return update.reordered(spatial_order(means, step.scene_extent))


def spatial_order(means: Tensor, extent: float) -> Tensor:
    """Rows in Morton order (Morton 1966, "A computer oriented geodetic data base").

    Coordinates go through x / (extent + |x|) first, so that everything has a place, however far away. Ties keep their
    order, and what is not finite is among the last. Does not wait for the GPU.

    Args:
        means: [N, 3] float.
        extent: of the scene, in their unit; this far from the origin, cells are four times as large as at it.

    Returns:
        [N] int64, a permutation.
    """
    contracted = means / (extent + means.abs())  # [N, 3], within (-1, 1)
    cells = ((contracted.double() + 1.0) * 2.0 ** (BITS - 1)).nan_to_num(2.0**BITS, 2.0**BITS)
    spread = cells.long().clamp(0, 2**BITS - 1)
    for shift, mask in SPREADS:
        spread = (spread | spread << shift) & mask
    keys = spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2
    return torch.argsort(keys, stable=True)
