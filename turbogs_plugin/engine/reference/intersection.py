"""Which splats reach which tiles: exactly those whose opacity reaches the threshold somewhere in the tile's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.engine.reference.projection import Rows, Splats
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.types import TILE_SIZE, PixelSamples

ROUNDING = 16
"""Rounding error allowed for a computed exponent: units in the last place of the largest of its terms."""


@dataclass
class Intersections:
    """The M intersections of a tile and a row that can contribute, front to back within each tile.

    Args:
        rows: [M] int64, ordered by (tile, depth, Gaussian).
        tile_counts: [T] int64, intersections of each tile of `PixelSamples.tile_ids`.
        slots: [M] int64, place of each in a second order, in which the intersections of a row are neighbours.
        row_counts: [R] int64, intersections of each row of `row_order`.
        row_order: [R] int64, the rows in that second order.
    """

    rows: Tensor
    tile_counts: Tensor
    slots: Tensor
    row_counts: Tensor
    row_order: Tensor

    def sum_by_row(self, values: Tensor) -> Tensor:
        """[R, C]: sums over the intersections of each row, in a fixed order, of values [M, C], of which
        `values[slots[i]]` belongs to intersection ``i``."""
        sums = torch.segment_reduce(values, "sum", lengths=self.row_counts, axis=0, unsafe=True)
        return torch.zeros_like(sums).index_copy(0, self.row_order, sums)


def smallest_exponents(conics: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """[C]: a lower bound, tight to rounding, of ``sigma = (a dx^2 + c dy^2) / 2 + b dx dy`` over rectangles. `conics`:
    [C, 3]; `low`, `high`: [C, 2] corners of the rectangles relative to the splats' centres.

    If a convex form has its minimum outside a rectangle, its smallest value there is on one of the two edges that face
    the minimum. Along an edge it is a parabola. If the minimum is inside, both candidates below are zero.
    """
    a, b, c = conics.unbind(dim=-1)
    near_x, near_y = torch.zeros_like(low).clamp(min=low, max=high).unbind(dim=-1)
    (low_x, low_y), (high_x, high_y) = low.unbind(dim=-1), high.unbind(dim=-1)

    def exponent(dx: Tensor, dy: Tensor) -> Tensor:
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy

    on_vertical = exponent(near_x, (-b * near_x / c).clamp(min=low_y, max=high_y))
    on_horizontal = exponent((-b * near_y / a).clamp(min=low_x, max=high_x), near_y)
    far_x, far_y = torch.maximum(low.abs(), high.abs()).unbind(dim=-1)
    terms = 0.5 * (a * far_x * far_x + c * far_y * far_y) + b.abs() * far_x * far_y
    return torch.minimum(on_vertical, on_horizontal) - ROUNDING * torch.finfo(a.dtype).eps * (1 + terms)


@torch.no_grad()
def intersect_tiles(rows: Rows, splats: Splats, samples: PixelSamples, settings: RasterSettings) -> Intersections:
    """Find the intersections of all tiles that hold samples.

    A splat with ``alpha >= alpha_min`` at some pixel of the tile is always found. A splat with less at every point of
    the rectangle of the tile's pixel centres is not, apart from rounding.
    """
    device = splats.means2d.device
    sizes = torch.as_tensor(samples.sizes, device=device)  # [K, 2]
    grid = samples.grid
    shapes = torch.as_tensor(grid.shapes, device=device)
    offsets = torch.as_tensor(grid.starts, device=device)
    num_tiles = len(samples.tile_ids)
    position = torch.full((len(grid),), -1, dtype=torch.int64, device=device)
    position[samples.tile_ids.long()] = torch.arange(num_tiles, device=device)

    # Front to back; a stable sort keeps equal depths in the order of the Gaussians.
    on_screen = (splats.radii > 0).any(dim=-1)
    order = torch.where(on_screen, splats.depths, torch.inf).sort(stable=True).indices  # [R]
    image = sizes[rows.views[order]]  # [R, 2]
    origin = torch.as_tensor(samples.origin, device=device)  # [2]
    means2d, radii = splats.means2d[order], splats.radii[order]
    # Pixel centres within the box of the radii, widened against rounding, as tiles [first, last].
    slack = 1 + ROUNDING * torch.finfo(means2d.dtype).eps * (means2d.abs() + radii)
    first = (means2d - radii - 0.5 - slack).clamp(min=0)
    last = (means2d + radii - 0.5 + slack).clamp(min=-1)
    first = (torch.minimum(first, image.to(first.dtype)).long() + origin) // TILE_SIZE
    last = (torch.minimum(last, (image - 1).to(last.dtype)).floor().long() + origin) // TILE_SIZE
    spans = (last - first + 1).clamp(min=0) * on_screen[order, None]  # [R, 2] tiles in x and y

    counts = spans.prod(dim=-1)  # [R] candidates of each row, C in all
    owners = torch.repeat_interleave(torch.arange(len(counts), device=device), counts)  # [C]
    number = torch.arange(len(owners), device=device) - (counts.cumsum(0) - counts)[owners]  # [C] within the owner
    column = number % spans[owners, 0] + first[owners, 0]
    line = number // spans[owners, 0] + first[owners, 1]
    tiles = position[offsets[rows.views[order]][owners] + line * shapes[rows.views[order]][owners, 0] + column]

    start = torch.stack([column, line], dim=-1) * TILE_SIZE - origin
    low, high = start.clamp(min=0), torch.minimum(start + TILE_SIZE, image[owners]) - 1
    centers = means2d[owners]
    smallest = smallest_exponents(splats.conics[order][owners], low + 0.5 - centers, high + 0.5 - centers)
    limits = torch.log(splats.opacities[order] / settings.alpha_min)[owners]
    kept = (tiles >= 0) & (smallest <= limits)

    owners, tiles = owners[kept], tiles[kept]
    slots = tiles.sort(stable=True).indices  # [M] front to back within each tile
    return Intersections(
        rows=order[owners[slots]],
        tile_counts=torch.bincount(tiles, minlength=num_tiles),
        slots=slots,
        row_counts=torch.bincount(owners, minlength=len(order)),
        row_order=order,
    )
