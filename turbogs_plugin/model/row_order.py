"""The order of the rows: along a curve through space, so that near Gaussians are near in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.types import Gaussians, RowUpdate, Step

BITS = 21
"""Bits of a coordinate: three coordinates fill 63 bits."""
SPREADS = tuple(
    (2 * run, sum((1 << run) - 1 << 3 * run * place for place in range(BITS)) & (1 << 3 * BITS) - 1)
    for run in (16, 8, 4, 2, 1)
)
"""Shifts and masks that put two empty bits behind each of the 21 bits: runs of bits move apart, then their halves."""


def in_order_of_space(update: RowUpdate, gaussians: Gaussians, step: Step) -> RowUpdate:
    """`update` with its new rows sorted in space. `gaussians` are as before it, with the cameras' centre as origin.

    Kernels read the splats of a tile, and add to them, by row; so splats seen together should be near in memory. After
    `Step.refine_until` the change stays as it is: Gaussians are then only removed, which leaves the others in order."""
    if step.iteration > step.refine_until:
        return update
    return update.taking(spatial_order(update.new("means", gaussians), step.scene_extent))


def spatial_order(means: Tensor, extent: float) -> Tensor:
    """[N] int64: rows of `means` [N, 3] in Morton order (Morton 1966, "A computer oriented geodetic data base").

    Coordinates are first mapped by x / (extent + |x|), so that every point has a place, however far away: at one extent
    cells are four times as large as at the origin. Ties keep their order, and points that are not finite are among the
    last. Does not wait for the GPU."""
    contracted = means / (extent + means.abs())  # [N, 3], within (-1, 1)
    cells = ((contracted.double() + 1.0) * 2.0 ** (BITS - 1)).nan_to_num(2.0**BITS, 2.0**BITS)
    spread = cells.long().clamp(0, 2**BITS - 1)
    for shift, mask in SPREADS:
        spread = spread * (1 + (1 << shift)) & mask  # x | x << shift, as no bits of these meet
    keys = (spread << torch.arange(3, device=spread.device)).sum(dim=1)
    return torch.argsort(keys, stable=True)
